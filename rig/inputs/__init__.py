"""What comes from outside and may be wrong: the error that says so, and how YAML is read."""
