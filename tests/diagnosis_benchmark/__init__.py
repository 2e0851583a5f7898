"""The full benchmark of `rig diagnose` on benches whose truth is known; `--help` says how."""
