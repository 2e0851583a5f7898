"""One tick of the bridge: values in, values out; no bus, clock, file or logging."""
