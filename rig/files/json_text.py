"""JSON that every reader accepts."""

import json
import math
from typing import cast


def json_text(content: object) -> str:
    """The content as JSON text, indented; numbers that are not finite become null."""
    return json.dumps(_finite(content), indent=2, ensure_ascii=False) + "\n"


def _finite(content: object) -> object:
    if isinstance(content, dict):
        items = cast("dict[object, object]", content).items()
        return {str(key): _finite(item) for key, item in items}
    if isinstance(content, list | tuple):
        return [_finite(item) for item in cast("list[object]", content)]
    return None if isinstance(content, float) and not math.isfinite(content) else content
