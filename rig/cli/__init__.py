"""The `rig` command: one module a command for arguments, printing and exit codes."""
