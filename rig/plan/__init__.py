"""A configuration with its model and DBC: read, resolved, checked, proposed."""
