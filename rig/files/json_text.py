"""JSON that every reader accepts."""

import json
import math
from typing import cast


def json_text(content: object) -> str:
    """The content as JSON text, indented.

    Named tuples become objects, and numbers that are not finite become null.
    """
    return json.dumps(_plain(content), indent=2, ensure_ascii=False) + "\n"


def _plain(content: object) -> object:
    as_dict = getattr(content, "_asdict", None)
    if as_dict is not None:
        content = as_dict()
    if isinstance(content, dict):
        items = cast("dict[object, object]", content).items()
        return {str(key): _plain(item) for key, item in items}
    if isinstance(content, list | tuple):
        return [_plain(item) for item in cast("list[object]", content)]
    return None if isinstance(content, float) and not math.isfinite(content) else content
