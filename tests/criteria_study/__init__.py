"""How the answers of `rig diagnose` move with each number that decides."""
