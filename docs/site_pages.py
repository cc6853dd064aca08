"""MkDocs hook: navigation, generated pages, and links to files outside docs/.

See https://www.mkdocs.org/user-guide/configuration/#hooks. The files in docs/ also work on GitHub.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from posixpath import dirname, join, normpath, relpath
from typing import TYPE_CHECKING, Any

import site_reference
from mkdocs.structure.files import File, Files

if TYPE_CHECKING:
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.pages import Page

ROOT = Path(__file__).parent.parent
HOW_TO = (
    "connecting", "state", "waiting", "actions", "maneuvers", "errors", "parameters", "missions", "set-points",
    "sticks", "external", "precision-landing", "files-and-logs", "cameras", "gimbals", "corrections", "calibration",
    "outputs-and-devices", "px4-tools", "components", "being-a-component", "being-a-camera", "being-a-device",
    "messages", "events", "links", "several-links", "bad-radio", "signing", "several-vehicles", "own-loop", "sync",
    "recording", "dialects", "testing", "logging",
)  # fmt: skip
NAVIGATION: dict[str, list[str]] = {
    "Tutorial": ["tutorial.md"],
    "How-to": ["how-to/index.md", *(f"how-to/{name}.md" for name in HOW_TO), "fleets.md"],
    "Coming from": [
        "coming-from/index.md", "coming-from/dronekit.md", "from-dronekit.md", "coming-from/mavsdk.md",
        "coming-from/pymavlink.md", "coming-from/mavros.md",
    ],
    "Concepts": ["concepts.md", "glossary.md"],
    "Tools": ["command-line.md", "hub.md", "monitor.md", "report.md", "serve.md", "network.md", "convert.md"],
    "Reference": ["reference/*.md"],
    "Troubleshooting": ["troubleshooting.md"],
    "Gallery": ["gallery.md", "examples/*.md"],
    "About": [
        "design.md", "design-rooms.md", "reliability.md", "verification.md", "firmware.md", "benchmarks.md",
        "features.md", "features-onboard.md", "states.md", "addresses.md", "signing.md", "simulator.md", "testing.md",
        "about/*.md",
    ],
}  # fmt: skip
"""Maps the title of a tab to its pages and patterns, in order. Missing pages are skipped; an unlisted page fails the
build."""
ROOT_PAGES = {
    "CHANGELOG.md": "about/changelog.md",
    "CONTRIBUTING.md": "about/contributing.md",
    "SECURITY.md": "about/security.md",
}
"""Maps a file outside docs/ to its page on the site."""
INSTALL = """
??? info "Install aerokit"

    From a clone of the repository, or from the wheel that `nox -s release` builds:

    ```sh
    pip install "aerokit-mavlink @ file:///path/to/clone"
    ```

    With extras: `aerokit-mavlink[all] @ file:///path/to/clone`. The package is not on PyPI yet, where `aerokit` is
    another project.
"""
LINK = re.compile(r"(!?)\[((?:[^\[\]]|\[[^\]]*\])*)\]\(([^)\s#]*)(#[^)\s]*)?\)")
RAISED = re.compile(r"(<li class=\"doc-section-item field-body\">\s*<code>)(\w+)(</code>)")
ROLE = re.compile(r":(?:class|func|meth|mod|attr|data|exc):(?=<code>)")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the generated pages and the navigation."""
    for path, text in generated_pages():
        files.append(File.generated(config, path, content=text))
    config.nav = navigation([file.src_uri for file in files.documentation_pages()])
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Convert links to files of the repository, and add the install instructions to pages of the guide."""
    sources = {page_path: source for source, page_path in ROOT_PAGES.items()}
    source = sources.get(page.file.src_uri, f"docs/{page.file.src_uri}")
    text = outside_code(
        markdown, lambda part: LINK.sub(lambda link: converted_link(link, source, page.file.src_uri), part)
    )
    if page.file.src_uri == "index.md" or page.file.src_uri.startswith("reference/"):
        return text  # the home page has its own install instructions
    title, _, rest = text.partition("\n")
    return f"{title}\n{INSTALL}{rest}"


def on_page_content(html: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Remove Sphinx roles (``:class:`…```), which MkDocs would show as text, and add links to exceptions."""
    return RAISED.sub(r'\1<autoref identifier="aerokit.errors.\2" optional>\2</autoref>\3', ROLE.sub("", html))


# ------------------------------------------------------------------------------------ generated pages


def generated_pages() -> Iterator[tuple[str, str]]:
    """Yield the path on the site and the text of each generated page."""
    for source, page_path in ROOT_PAGES.items():
        yield page_path, (ROOT / source).read_text(encoding="utf-8")
    for path in example_files():
        name = path.relative_to(ROOT)
        yield (
            example_page(name.as_posix()),
            f"# {name}\n\n```python\n{path.read_text(encoding='utf-8')}```\n",
        )
    yield from site_reference.reference_pages()


def example_files() -> list[Path]:
    """Return every program of examples/."""
    return sorted((ROOT / "examples").rglob("*.py"))


def example_page(path: str) -> str:
    """Return the page of an example: ``examples/dronekit/hello.py`` → ``examples/dronekit-hello.md``."""
    name = path.removeprefix("examples/").removesuffix(".py").replace("/", "-")
    return f"examples/{name}.md"


def navigation(pages: list[str]) -> list[Any]:
    """Return the tabs with their existing pages."""
    left = [page for page in pages if page != "index.md"]
    tabs: list[Any] = [{"aerokit": "index.md"}]
    for title, wanted in NAVIGATION.items():
        found: list[str] = []
        for pattern in wanted:
            matching = [page for page in left if re.fullmatch(pattern.replace("*", "[^/]*"), page)]
            found += matching
            left = [page for page in left if page not in matching]
        if title == "Reference":
            tabs.append({title: site_reference.navigation()})
        elif found:
            tabs.append({title: found[0] if wanted == found and len(found) == 1 else found})
    return tabs


# ------------------------------------------------------------------------------------ links


def outside_code(markdown: str, change: Any) -> str:
    """Apply ``change`` to everything outside code blocks."""
    parts = re.split(r"(^ *```.*?^ *```$)", markdown, flags=re.DOTALL | re.MULTILINE)
    return "".join(part if number % 2 else change(part) for number, part in enumerate(parts))


def converted_link(link: re.Match[str], source: str, page: str) -> str:
    """Convert a link to a file of the repository to a link to its page; without a page, return only its text."""
    picture, label, target, anchor = link[1], link[2], link[3], link[4] or ""
    if not target or "://" in target or target.startswith("mailto:"):
        return link[0]
    path = normpath(join(dirname(source), target))
    target_page = site_page(path)
    if target_page is None:
        return label
    return f"{picture}[{label}]({relpath(target_page, dirname(page) or '.')}{anchor})"


def site_page(path: str) -> str | None:
    """Return the page of a file of the repository."""
    if path.startswith("docs/"):
        return path.removeprefix("docs/")
    if path == "README.md":
        return "index.md"
    if path in ROOT_PAGES:
        return ROOT_PAGES[path]
    if path.startswith("examples/") and path.endswith(".py"):
        return example_page(path)
    if path in ("examples", "examples/dronekit", "examples/testing_a_mission"):
        return "gallery.md" if (ROOT / "docs" / "gallery.md").exists() else None
    return site_reference.SOURCE_PAGES.get(path)
