"""An executor without threads."""

from concurrent.futures import Executor, Future

from rig.bus.bus import BusError


class AtOnce(Executor):
    """Runs what it is given before `submit` returns."""

    def submit(self, fn, /, *args, **kwargs):
        future = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except BusError as error:
            future.set_exception(error)
        return future
