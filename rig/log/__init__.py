"""The folder of a run: written, read, followed while it grows, rotated."""
