"""What MkDocs does with our pages, which are written to be read in the repository too.

Links to files outside of ``docs/`` lead to pages of the site that show them, and LaTeX becomes MathML, which browsers draw
without a script.
"""

from __future__ import annotations

import posixpath
import re
from pathlib import Path
from typing import Any

import latex2mathml.converter
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parents[2]
PAGES = {"README.md": "index.md", "CONTRIBUTING.md": "contributing.md", "CHANGELOG.md": "changes.md"}
"""Pages of the repository outside of ``docs/``, and what the site calls them."""
LANGUAGES = {".py": "python", ".yaml": "yaml", ".yml": "yaml", ".c": "c", ".cff": "yaml"}
PICTURES = (".png", ".svg", ".gif")
_LINK = re.compile(r"(\]\()([^)\s]+)(\))")
_CODE = re.compile(r"(^```.*?^```|`[^`\n]*`)", re.M | re.S)
_MATH_BLOCK = re.compile(r"^```math\n(.*?)^```", re.M | re.S)
_MATH = re.compile(r"\$([^$\n]+)\$")
_ROLE = re.compile(r":(?:class|func|meth|attr|mod|data):<code>(~?)([^<]+)</code>")
_formulas: list[str] = []


def on_files(files: Files, config: Any) -> Files:
    """Add the pages that stand outside of ``docs/``, and a page for each other file that a page links to."""
    shown = set()
    for file in [file for file in files if file.src_uri.endswith(".md")]:
        shown |= _outside(file.content_string, f"docs/{file.src_uri}")
    for source, page in PAGES.items():
        text = (ROOT / source).read_text()
        shown |= _outside(text, source)
        files.append(File.generated(config, page, content=text))
    for folder in sorted(source for source in shown if (ROOT / source).is_dir()):
        names = sorted(entry.name for entry in (ROOT / folder).glob("*.py"))
        text = f"# {folder}\n\n" + "\n".join(f"- [{name}]({folder}/{name}.md)" for name in names)
        files.append(File.generated(config, _uri(folder), content=text))
        shown |= {f"{folder}/{name}" for name in names}
    for source in sorted(shown - set(PAGES)):
        path = ROOT / source
        if path.suffix in PICTURES:
            files.append(File.generated(config, _uri(source), abs_src_path=str(path)))
        elif path.is_file():
            text = f"# {source}\n\n````{LANGUAGES.get(path.suffix, 'text')}\n{path.read_text()}````\n"
            files.append(File.generated(config, _uri(source), content=text))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Lead links to the site's pages, and put formulas aside."""
    if page.file.src_uri.startswith("files/"):
        return markdown
    source = next((name for name, uri in PAGES.items() if uri == page.file.src_uri), f"docs/{page.file.src_uri}")

    def lead(found: re.Match[str]) -> str:
        path, mark, anchor = found[2].partition("#")
        inside = _resolve(path, source)
        if "://" in found[2] or not path or inside is None:
            return found[0]
        relative = posixpath.relpath(_uri(inside), posixpath.dirname(page.file.src_uri) or ".")
        return f"{found[1]}{relative}{mark}{anchor}{found[3]}"

    def put_aside(found: re.Match[str], display: str) -> str:
        _formulas.append(latex2mathml.converter.convert(found[1].strip(), display=display))
        return f"FORMULA{len(_formulas) - 1}FORMULA"

    markdown = _MATH_BLOCK.sub(lambda found: put_aside(found, "block"), markdown)
    parts = _CODE.split(markdown)
    for place in range(0, len(parts), 2):
        parts[place] = _MATH.sub(lambda found: put_aside(found, "inline"), parts[place])
    return _LINK.sub(lead, "".join(parts))


def on_page_content(html: str, **_: Any) -> str:
    """Put the formulas back, and take off Sphinx's roles, which the docstrings have."""
    html = _ROLE.sub(lambda found: f"<code>{found[2].rpartition('.')[2] if found[1] else found[2]}</code>", html)
    return re.sub(r"FORMULA(\d+)FORMULA", lambda found: _formulas[int(found[1])], html)


def _uri(source: str) -> str:
    """Where the site shows a file or folder of the repository."""
    if source.startswith("docs/"):
        return source.removeprefix("docs/")
    return PAGES.get(source) or f"files/{source}" + ("" if Path(source).suffix in PICTURES else ".md")


def _resolve(path: str, source: str) -> str | None:
    """The file of the repository that a link of a source leads to; ``None`` where there is none."""
    target = posixpath.normpath(posixpath.join(posixpath.dirname(source), path))
    return target if not target.startswith("..") and (ROOT / target).exists() else None


def _outside(text: str, source: str) -> set[str]:
    """The files outside of ``docs/`` that a page links to."""
    targets = (_resolve(path.partition("#")[0], source) for _, path, _ in _LINK.findall(text) if "://" not in path)
    return {target for target in targets if target and target != "." and not target.startswith("docs")}
