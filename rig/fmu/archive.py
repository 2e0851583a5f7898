"""An FMU as one file: description, C sources, and binaries for every system."""

import hashlib
import html
import io
import zipfile
from collections.abc import Callable, Iterable
from uuid import UUID

from rig.fmu.binaries import TARGETS, Target, compile_for
from rig.fmu.component import Component
from rig.fmu.description import build_description, description_2, description_3
from rig.fmu.source import select_c_files, sources
from rig.machine.installed_versions import version_of

_FILE_TIME = (1980, 1, 1, 0, 0, 0)
"""Time of every file in the archive, so that the same model gives the same bytes."""


def archive(
    component: Component,
    version: str,
    model: str,
    targets: Iterable[Target] = TARGETS,
    done: Callable[[Target], None] = lambda _: None,
) -> bytes:
    """An FMU for Model Exchange and Co-Simulation.

    It contains `model`, the text of the model file, too, and no binaries for systems that its
    version has no name for. `done` is called after each system.

    Raises:
        InputError: There is no compiler, or it refuses.
    """
    tool = f"rig {version_of('rig')}"
    token = _token(component, version, tool)
    code = sources(component, version, token)
    c_files = select_c_files(code)
    files: dict[str, bytes | str] = {}
    if version == "2.0":
        files["modelDescription.xml"] = description_2(component, tool, token, c_files)
    else:
        files["modelDescription.xml"] = description_3(component, tool, token)
        files["sources/buildDescription.xml"] = build_description(component, c_files)
    files |= {f"sources/{name}": text for name, text in code.items()}
    files["resources/model.yaml"] = model
    files["documentation/index.html"] = _page(component)
    supported = [target for target in targets if target.folder(version) is not None]
    binaries = compile_for(supported, code, component.identifier, done)
    for target, content in binaries.items():
        name = f"{component.identifier}{target.suffix}"
        files[f"binaries/{target.folder(version)}/{name}"] = content
    return _zip_files(files)


def _token(component: Component, version: str, tool: str) -> str:
    """A token that only the same content has."""
    code = sources(component, version, "")
    text = "\0".join([tool, version, *(f"{name}\0{code[name]}" for name in sorted(code))])
    return f"{{{UUID(bytes=hashlib.sha256(text.encode()).digest()[:16])}}}"


def _zip_files(files: dict[str, bytes | str]) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as zipped:
        for name, content in files.items():
            entry = zipfile.ZipInfo(name, _FILE_TIME)
            entry.compress_type = zipfile.ZIP_DEFLATED
            entry.external_attr = 0o644 << 16
            zipped.writestr(entry, content)
    return buffer.getvalue()


def _page(component: Component) -> str:
    """The page for a user who unpacks the FMU."""
    rows = "".join(
        f"<tr><td><code>{html.escape(item.name)}</code></td><td>{item.kind}</td>"
        f"<td>{'' if item.start is None else f'{item.start:.9g}'}</td>"
        f"<td>{html.escape(item.unit)}</td><td>{html.escape(item.meaning)}</td></tr>\n"
        for item in component.variables
        if item.kind not in ("indicator", "rate")
    )
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        f"<title>{html.escape(component.name)}</title></head><body>\n"
        f"<h1>{html.escape(component.name)}</h1>\n<p>{html.escape(component.meaning)}</p>\n"
        "<p>Co-Simulation advances by Kutta's method of third order in equal steps of at most "
        "<code>longest_step_s</code>, and holds the inputs over a step, or lets them rise as "
        "<code>fmi2SetRealInputDerivatives</code> says. In Model Exchange the laws switch at "
        "events. The model file is <code>resources/model.yaml</code>.</p>\n"
        "<table><tr><th>Variable</th><th>Kind</th><th>Start</th><th>Unit</th><th>Meaning</th>"
        f"</tr>\n{rows}</table>\n</body></html>\n"
    )
