"""The lowest package: what bytes from outside mean, on a bus (DBC, frames) and in a YAML file."""
