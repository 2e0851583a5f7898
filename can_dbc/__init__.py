"""What the bytes on the bus mean: database, codecs and end-to-end protection."""
