"""The harness: plans and runs tasks in child processes, scores the answers, and keeps the rows."""
