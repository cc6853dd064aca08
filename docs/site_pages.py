"""What MkDocs does beyond the pages of docs/: the navigation, the start page, examples, and links that leave docs/.

A hook (https://www.mkdocs.org/user-guide/configuration/#hooks) of mkdocs.yml. The pages stay as GitHub shows them.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from posixpath import dirname, join, normpath, relpath
from typing import TYPE_CHECKING, Any

from mkdocs.structure.files import File, Files
from site_reference import HOMES, MADE, ROOMS, reference_pages

if TYPE_CHECKING:
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.pages import Page

ROOT = Path(__file__).parent.parent
HOW_TO = (
    "connecting", "state", "waiting", "actions", "errors", "parameters", "missions", "set-points", "files-and-logs",
    "cameras", "gimbals", "components", "messages", "events", "links", "several-links", "bad-radio", "signing",
    "several-vehicles", "own-loop", "sync", "recording", "dialects", "testing", "logging",
)  # fmt: skip
NAVIGATION: dict[str, list[str]] = {
    "Tutorial": ["tutorial.md"],
    "How-to": ["how-to/index.md", *(f"how-to/{name}.md" for name in HOW_TO), "fleets.md"],
    "Coming from": [
        "coming-from/index.md", "coming-from/dronekit.md", "from-dronekit.md", "coming-from/mavsdk.md",
        "coming-from/pymavlink.md", "coming-from/mavros.md",
    ],
    "Concepts": ["concepts.md"],
    "Tools": ["command-line.md", "hub.md", "monitor.md", "report.md", "serve.md", "network.md", "convert.md"],
    "Reference": ["reference/index.md", *(f"reference/{page}.md" for page in (*(room.page for room in ROOMS), *MADE))],
    "Troubleshooting": ["troubleshooting.md"],
    "Gallery": ["gallery.md", "examples/*.md"],
    "About": [
        "design.md", "design-rooms.md", "reliability.md", "firmware.md", "benchmarks.md", "features.md", "states.md",
        "addresses.md",
        "signing.md", "simulator.md", "testing.md", "about/*.md",
    ],
}  # fmt: skip
"""Tab: pages and patterns, in this order. What does not exist is left out; a page that stands nowhere is an error."""
FROM_THE_ROOT = {
    "README.md": "index.md",
    "CHANGELOG.md": "about/changelog.md",
    "CONTRIBUTING.md": "about/contributing.md",
    "SECURITY.md": "about/security.md",
}
"""Pages that live above docs/, and where they are on the site."""
INSTALL = """
??? info "Install it for a project of your own"

    From a clone of the repository, or from the wheel that `nox -s release` makes of it:

    ```sh
    pip install "aerokit-mavlink @ file:///path/to/clone"
    ```

    Extras stand behind the name: `aerokit-mavlink[all] @ file:///path/to/clone`. Once it is published on PyPI, the name
    is enough: `pip install aerokit-mavlink`. (`aerokit` there is another project.)
"""
LINK = re.compile(r"(!?)\[((?:[^\[\]]|\[[^\]]*\])*)\]\(([^)\s#]*)(#[^)\s]*)?\)")
ROLE = re.compile(r":(?:class|func|meth|mod|attr|data|exc):(?=<code>)")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages that are made here."""
    for path, text in made_pages():
        files.append(File.generated(config, path, content=text))
    config.nav = navigation([file.src_uri for file in files.documentation_pages()])
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Lead links to files of the repository to their pages; say on every page how to install it."""
    is_made = {made: source for source, made in FROM_THE_ROOT.items()}
    source = is_made.get(page.file.src_uri, f"docs/{page.file.src_uri}")
    text = outside_code(
        markdown, lambda part: LINK.sub(lambda link: led(link, source, page.file.src_uri), part)
    )
    if page.file.src_uri == "index.md":
        return text.replace('src="docs/', 'src="')  # it has the line in its first screen
    title, _, rest = text.partition("\n")
    return f"{title}\n{INSTALL}{rest}"


def on_page_content(html: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Roles of docstrings (``:class:`…```) are for other tools."""
    return ROLE.sub("", html)


# ------------------------------------------------------------------------------------ pages that are made


def made_pages() -> Iterator[tuple[str, str]]:
    """Path on the site, text."""
    for source, made in FROM_THE_ROOT.items():
        yield made, (ROOT / source).read_text(encoding="utf-8")
    for path in example_files():
        shown = path.relative_to(ROOT)
        yield (
            example_page(shown.as_posix()),
            f"# {shown}\n\n```python\n{path.read_text(encoding='utf-8')}```\n",
        )
    yield from reference_pages()


def example_files() -> list[Path]:
    """Every program of examples/."""
    return sorted((ROOT / "examples").rglob("*.py"))


def example_page(path: str) -> str:
    """Its page: ``examples/dronekit/hello.py`` → ``examples/dronekit-hello.md``."""
    name = path.removeprefix("examples/").removesuffix(".py").replace("/", "-")
    return f"examples/{name}.md"


def navigation(pages: list[str]) -> list[Any]:
    """The tabs, with what there is of their pages."""
    left = [page for page in pages if page != "index.md"]
    tabs: list[Any] = [{"aerokit": "index.md"}]
    for title, wanted in NAVIGATION.items():
        found: list[str] = []
        for pattern in wanted:
            matching = [page for page in left if re.fullmatch(pattern.replace("*", "[^/]*"), page)]
            found += matching
            left = [page for page in left if page not in matching]
        if found:
            tabs.append({title: found[0] if wanted == found and len(found) == 1 else found})
    return tabs


# ------------------------------------------------------------------------------------ links


def outside_code(markdown: str, change: Any) -> str:
    """Change what is no block of code."""
    parts = re.split(r"(^ *```.*?^ *```$)", markdown, flags=re.DOTALL | re.MULTILINE)
    return "".join(part if number % 2 else change(part) for number, part in enumerate(parts))


def led(link: re.Match[str], source: str, page: str) -> str:
    """A link of a file of the repository, as a link of its page on the site; text alone where no page is."""
    picture, label, target, anchor = link[1], link[2], link[3], link[4] or ""
    if not target or "://" in target or target.startswith("mailto:"):
        return link[0]
    path = normpath(join(dirname(source), target))
    place = site_page(path)
    if place is None:
        return label
    return f"{picture}[{label}]({relpath(place, dirname(page) or '.')}{anchor})"


def site_page(path: str) -> str | None:
    """Where a file of the repository is on the site."""
    if path.startswith("docs/"):
        return path.removeprefix("docs/")
    if path in FROM_THE_ROOT:
        return FROM_THE_ROOT[path]
    if path.startswith("examples/") and path.endswith(".py"):
        return example_page(path)
    if path in ("examples", "examples/dronekit", "examples/testing_a_mission"):
        return "gallery.md" if (ROOT / "docs" / "gallery.md").exists() else None
    return HOMES.get(path)
