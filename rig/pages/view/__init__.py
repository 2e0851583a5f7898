"""A page in the browser that follows runs while they are written, or shows finished ones.

    watched    what is known of a run's folder, whatever state it is in
    closely    what is computed of the stretch in sight: force over motion, spectrum, bus load
    server     answers the page, on loopback only
    page.*     the page

The page asks and the server answers; a page that is stalled asks nothing. Nothing here can delay a
run: all is read from its folder, by another process.
"""
