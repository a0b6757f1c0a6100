"""What the documentation site adds to docs/*.md: a reference, the notebook, typeset formulas.

Hooks of MkDocs; `make docs` builds the site.
"""

import ast
import re
from base64 import b64decode
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import nbformat
from latex2mathml.converter import convert
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page
from nbclient import NotebookClient

from ep2sindy._stubs import Entry, dotted_names

CONTENTS = """# Reference

Every public name, under `import ep2sindy as ep`. Everything is SI unless its name says otherwise;
arrays are (sample, state), (row, term), (term, equation). What is wrong is a `ValueError` that says
what must hold, what arrived, and the way out.
"""
NOTEBOOK = "first_steps.ipynb"


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """The reference in the navigation, page by page."""
    (section,) = (part for part in config.nav if "Reference" in part)
    section["Reference"] = ["reference/index.md", *(f"reference/{_path(t)}" for t in reference())]
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    pages: dict[str, str | bytes] = {
        f"reference/{_path(title)}": _page(title, names) for title, names in reference().items()
    }
    pages["reference/index.md"] = _contents()
    pages |= notebook_files(Path(config.docs_dir) / NOTEBOOK)
    for path, text in pages.items():
        files.append(File.generated(config, path, content=text))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Pages called by their titles; links and cells of HTML tables, as GitHub reads them."""
    if page.file.src_uri != "first_steps.md":
        markdown = markdown.replace(f"({NOTEBOOK})", "(first_steps.md)")

    def titled(link: re.Match[str]) -> str:
        target = files.get_file_from_path(link[1])
        title = target and re.match(r"# (.*)", target.content_string)
        return f"[{title[1]}]({link[2]})" if title else link[0]

    markdown = re.sub(r"\[(\w+\.md)\]\((\1[^)]*)\)", titled, markdown)
    return re.sub(r"<(table|tr|td|th)>", r'<\1 markdown="1">', markdown)


def on_page_content(html: str, **_: Any) -> str:
    """Formulas as MathML, so that no page needs a script for them."""
    html = re.sub(
        r'<span class="arithmatex">\\\((.*?)\\\)</span>', lambda m: _formula(m[1], "inline"), html
    )
    return re.sub(
        r'<div class="arithmatex">\\\[(.*?)\\\]</div>',
        lambda m: f'<div class="formula">{_formula(m[1], "block")}</div>',
        html,
        flags=re.DOTALL,
    )


def _formula(tex: str, display: str) -> str:
    plain = tex.replace("&lt;", "<").replace("&gt;", ">").replace("&amp;", "&")
    return convert(plain.strip(), display=display)


def reference() -> dict[str, list[str]]:
    """Pages of the reference, the headings of the stubs -> their names, in the stubs' order."""
    pages: dict[str, list[str]] = {}
    for name, entry in dotted_names().items():
        pages.setdefault(entry.heading, []).append(name)
    return pages


def _path(title: str) -> str:
    return title.lower().replace(" ", "_") + ".md"


def _page(title: str, names: list[str]) -> str:
    entries = "\n\n".join(f"::: {name}" for name in names)
    return f"# {title}\n\nAll names are those of `import ep2sindy as ep`.\n\n{entries}\n"


def _contents() -> str:
    """All names with the first line of their docstring, page by page."""
    names = dotted_names()
    lines = [CONTENTS]
    for title, here in reference().items():
        lines += [f"## [{title}]({_path(title)})", "", "| name | what it is |", "|---|---|"]
        for name in here:
            link = f"[`{name.removeprefix('ep2sindy.')}`][{name}]"
            summary = docstring(names[name]).partition("\n")[0]
            lines.append(f"| {link} | {summary} |")
        lines.append("")
    return "\n".join(lines)


def docstring(entry: Entry) -> str:
    """Read from the source, for importing all of the face takes long; empty if there is none."""
    nodes = _module(entry.module).body
    for node, after in zip(reversed(nodes), [None, *reversed(nodes)], strict=False):
        if isinstance(node, ast.ClassDef | ast.FunctionDef) and node.name == entry.name:
            return ast.get_docstring(node) or ""  # of overloads the last
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == entry.name:
            return ast.get_docstring(ast.Module([after], [])) or "" if after else ""
    return ""


@cache
def _module(name: str) -> ast.Module:
    spec = find_spec(name)
    assert spec is not None
    assert spec.origin is not None, name
    return ast.parse(Path(spec.origin).read_text("utf-8"))


def notebook_files(path: Path) -> dict[str, str | bytes]:
    """A notebook as a page: its cells, what they give when they are run now, and the figures."""
    notebook = nbformat.read(path, as_version=4)
    with TemporaryDirectory() as folder:
        NotebookClient(notebook, timeout=300, resources={"metadata": {"path": folder}}).execute()
    files: dict[str, str | bytes] = {}
    parts = []
    for cell in notebook.cells:
        if cell.cell_type == "markdown":
            parts.append(cell.source)
            continue
        parts.append(f"```python\n{cell.source}\n```")
        for output in cell.outputs:
            data = output.get("data", {})
            if "image/png" in data:
                name = f"{path.stem}_{len(files)}.png"
                files[name] = b64decode(data["image/png"])
                parts.append(f"![What the cell draws]({name})")
            elif text := (output.get("text") or data.get("text/plain", "")).strip():
                parts.append(f"```text\n{text}\n```")
    offer = f"*This page is a notebook, run when the site was built: [download it]({path.name}).*"
    files[f"{path.stem}.md"] = "\n\n".join([parts[0], offer, *parts[1:]]) + "\n"
    return files
