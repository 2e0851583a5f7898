"""Folders and delimited text, for every reader and writer of measured data."""
