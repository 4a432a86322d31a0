"""Reports: tables and figures from a results store; nothing here measures."""
