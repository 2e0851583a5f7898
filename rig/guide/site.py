"""The guide as a web site: Markdown pages, what the code knows put into them, built by MkDocs.

Lists and tables that the code knows stand in a page between `<!-- generated: NAME -->` and
`<!-- end -->`. They are written again when the site is built, with pictures, so that no page can
contradict the program. Everything the site needs is in its folder: pages and search work from a
file, without a network.
"""

import importlib
import io
import logging
import re
import shutil
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from can_dbc.errors import InputError
from rig.machine.installed_versions import version_of

PAGES = Path(__file__).with_name("pages")
"""Folder of the pages."""

GENERATED = re.compile(r"^<!-- generated: ([\w-]+) -->$.*?^<!-- end -->$", re.MULTILINE | re.DOTALL)
"""A part of a page that code knows."""

Block = Callable[[Path | None], str]
"""Markdown of a generated part; pictures are written into the folder that it is given, if any."""

_PICTURES = "generated"
"""Folder of generated pictures, below that of the pages."""

_NAVIGATION: dict[str, tuple[str, ...]] = {
    "Tutorials": (
        "tutorials/first-run",
        "tutorials/own-bench",
        "tutorials/dyno-file",
        "tutorials/read-a-diagnosis",
    ),
    "How to": (
        "how-to/adapter",
        "how-to/canopen-j1939",
        "how-to/several-struts",
        "how-to/inputs",
        "how-to/closed-loops",
        "how-to/several-sensors",
        "how-to/virtual-sensors",
        "how-to/tune",
        "how-to/supervise",
        "how-to/watch",
        "how-to/measured-data",
        "how-to/damper",
        "how-to/fleet",
        "how-to/fmu",
        "how-to/authenticate",
        "how-to/real-time",
        "how-to/python",
        "how-to/extend",
        "how-to/troubleshoot",
    ),
    "Reference": (
        "reference/commands",
        "reference/configuration",
        "reference/quantities",
        "reference/model-file",
        "reference/effects",
        "reference/mapping",
        "reference/simulated-bench",
        "reference/run-folder",
        "reference/diagnosis-json",
        "reference/faults",
        "reference/signs",
        "reference/glossary",
    ),
    "Explanation": (
        "explanation/method",
        "explanation/observers",
        "explanation/validity",
        "explanation/sample-times",
        "explanation/timing",
        "explanation/diagnosis",
        "explanation/attribution",
        "explanation/verdicts",
        "explanation/damper-figures",
        "explanation/architecture",
    ),
}
"""Pages by their kind, in the order in which to read them."""

_LISTED = {"Decisions": "explanation/decisions", "Evidence": "evidence"}
"""Folders of which each page is listed, by its title."""

_EXTENSIONS: tuple[str, ...] = (
    "admonition",
    "attr_list",
    "md_in_html",
    "tables",
    "pymdownx.highlight",
)


def build_site(folder: Path, blocks: Mapping[str, Block]) -> Path:
    """Build the site into a folder that is new or empty; returns its first page.

    Args:
        folder: Where it is built.
        blocks: Generated parts, by the names that stand in the pages.

    Raises:
        InputError: The folder is not empty or cannot be written, MkDocs is not installed, or a
            page names a generated part that there is not.
    """
    if folder.is_dir() and any(folder.iterdir()):
        raise InputError(f"{folder}: is not empty, expected a new folder")
    build, load = _mkdocs()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except FileExistsError:
        raise InputError(f"{folder}: is a file, expected a new folder") from None
    except OSError as error:
        raise InputError(f"{folder}: cannot be written: {error.strerror}") from error
    with tempfile.TemporaryDirectory() as name:
        source = Path(name) / "pages"
        shutil.copytree(PAGES, source)
        _fill(source, blocks)
        config = Path(name) / "mkdocs.yml"
        config.write_text("site_name: rig\n", "utf-8")
        settings = _settings(source, folder.resolve())
        _build_strictly(lambda: build(load(str(config), **settings)))
    return folder / "index.html"


def _build_strictly(build: Callable[[], None]) -> None:
    """Build, and raise what MkDocs warns of, such as a link that leads nowhere."""
    found = io.StringIO()
    handler = logging.StreamHandler(found)
    handler.setLevel(logging.WARNING)
    logger = logging.getLogger("mkdocs")
    logger.addHandler(handler)
    try:
        build()
    except SystemExit:
        raise InputError(
            f"the guide cannot be built: {'; '.join(found.getvalue().splitlines())}"
        ) from None
    finally:
        logger.removeHandler(handler)


def _mkdocs() -> tuple[Callable[[Any], None], Callable[..., Any]]:
    try:
        importlib.import_module("material")
        build = importlib.import_module("mkdocs.commands.build").build
        load = importlib.import_module("mkdocs.config").load_config
    except ImportError:
        raise InputError(
            f"rig docs requires MkDocs Material: `pip install -e '.[guide]'`, or read {PAGES} as "
            "it is, in Markdown"
        ) from None
    return build, load


def _fill(source: Path, blocks: Mapping[str, Block]) -> None:
    """Put the generated parts into the pages."""
    pictures = source / _PICTURES
    pictures.mkdir()
    for page in sorted(source.rglob("*.md")):
        page.write_text(fill_page(page, blocks, pictures), "utf-8")


def fill_page(page: Path, blocks: Mapping[str, Block], pictures: Path | None) -> str:
    """Text of a page with its generated parts written again.

    Args:
        page: Markdown file.
        blocks: Generated parts, by their names.
        pictures: Folder for their pictures; without one they have none.

    Raises:
        InputError: The page names a part that there is not.
    """

    def fill(match: re.Match[str]) -> str:
        name = match[1]
        if name not in blocks:
            raise InputError(f"{page.name}: no generated part {name!r}")
        return f"<!-- generated: {name} -->\n\n{blocks[name](pictures).strip()}\n\n<!-- end -->"

    return GENERATED.sub(fill, page.read_text("utf-8"))


def _entry(source: Path, page: Path) -> dict[str, str]:
    """A page's entry in the navigation: its title, and its path."""
    title = page.read_text("utf-8").partition("\n")[0].removeprefix("# ")
    return {title: page.relative_to(source).as_posix()}


def _navigation(source: Path) -> list[dict[str, Any]]:
    listed = {head: sorted((source / folder).glob("*.md")) for head, folder in _LISTED.items()}
    named = {head: [source / f"{name}.md" for name in names] for head, names in _NAVIGATION.items()}
    heads = {
        head: [_entry(source, page) for page in pages]
        for head, pages in (named | listed).items()
        if pages
    }
    return [{"Home": "index.md"}, *({head: pages} for head, pages in heads.items())]


def _settings(source: Path, site: Path) -> dict[str, Any]:
    palette = [
        {
            "media": f"(prefers-color-scheme: {name})",
            "scheme": scheme,
            "primary": "indigo",
            "toggle": {"icon": icon, "name": f"Switch to {other} mode"},
        }
        for name, scheme, other, icon in (
            ("light", "default", "dark", "material/weather-night"),
            ("dark", "slate", "light", "material/weather-sunny"),
        )
    ]
    return {
        "site_name": f"rig {version_of('shock-rig')}",
        "docs_dir": str(source),
        "site_dir": str(site),
        "use_directory_urls": False,
        "strict": True,
        "validation": dict.fromkeys(("anchors", "absolute_links", "unrecognized_links"), "warn"),
        "nav": _navigation(source),
        "theme": {
            "name": "material",
            "font": False,
            "palette": palette,
            "features": ["navigation.tabs", "navigation.footer", "toc.follow", "content.code.copy"],
        },
        "plugins": [{"search": {"lang": "en"}}, "offline"],
        "markdown_extensions": [
            *_EXTENSIONS,
            {"toc": {"permalink": True}},
            {
                "pymdownx.superfences": {
                    "custom_fences": [{"name": "math", "class": "math", "format": _format_math}]
                }
            },
        ],
        # The offline plugin adds one from the network where none is named.
        "extra": {"generator": False, "polyfills": ["iframe-worker.js"]},
        "extra_css": ["style.css"],
        "extra_javascript": ["labels.js"],
        "copyright": "MIT licence",
    }


def _format_math(source: str, *_: object, **__: object) -> str:
    """An equation as MathML, which browsers draw by themselves."""
    convert = importlib.import_module("latex2mathml.converter").convert
    return f'<div class="equation">{convert(source, display="block")}</div>'
