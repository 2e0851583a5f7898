"""Observer, step and supervisor: values in, values out; no bus, clock, file or logging."""
