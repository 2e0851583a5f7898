"""A page in the browser that follows runs while they are written, or shows finished ones.

    run_status         state of a run's folder
    visible_stretch    curves and figures of the visible stretch: force over motion, bus load
    live_page, page.*  the page, and the plots that it draws
    diagnosis_job      a diagnosis that the page starts, in the process of diagnosis_worker
    server             serves the page, on loopback only
    foxglove           publishes the runs to Foxglove in place of the page

The page makes requests and the server answers; a page that is stalled makes none. Nothing here can
delay a run: everything is read from its folder, by another process.
"""
