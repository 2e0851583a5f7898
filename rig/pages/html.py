"""HTML pages from their templates, and their files."""

import base64
import hashlib
import io
import json
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from can_dbc.atomic_file import write_durably
from can_dbc.errors import InputError
from rig.pages import charts
from rig.pages.plotted_quantities import us_units

_HERE = Path(__file__).parent
_TEMPLATES = Environment(
    loader=FileSystemLoader(_HERE), autoescape=True, undefined=StrictUndefined,
    trim_blocks=True, lstrip_blocks=True,
)  # fmt: skip


def render(template: str, **content: object) -> str:
    """Text of a page, from a template below the folder of this module."""
    return _TEMPLATES.get_template(template).render(**content)


def render_report(template: str, **content: object) -> str:
    """Text of a report, from a template in ``report``: it holds its charts' scripts and styles."""
    report = _HERE / "report"
    own = report / "units.js", report / "page.js"
    scripts = [path.read_text("utf-8") for path in (*charts.SCRIPTS, *own)]
    return render(
        f"report/{template}",
        styles=[path.read_text("utf-8") for path in (*charts.STYLES, report / "page.css")],
        scripts=scripts,
        us_units=json.dumps(us_units()),
        script_hashes=[_hash(script) for script in scripts],
        **content,
    )


def svg_url(figure: Any) -> str:
    """A drawing of matplotlib as an SVG in a data URL."""
    image = io.BytesIO()
    figure.savefig(image, format="svg", metadata={"Date": None})
    return "data:image/svg+xml;base64," + base64.b64encode(image.getvalue()).decode("ascii")


def write_page(text: str, path: Path) -> None:
    """Write a page, whole or not at all.

    Raises:
        InputError: The file cannot be written.
    """
    try:
        write_durably(path, text)
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror}") from error


def _hash(script: str) -> str:
    digest = hashlib.sha256(script.encode("utf-8")).digest()
    return f"sha256-{base64.b64encode(digest).decode('ascii')}"
