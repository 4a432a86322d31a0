"""What a moving scene needs: bodies, walls, contacts, impacts, time stepping, checkpoints."""
