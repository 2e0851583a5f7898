"""Files and folders: what every reader and writer shares."""
