"""The documentation site: built without a warning, read in Chromium."""

import re
import subprocess
import sys
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from runpy import run_path
from threading import Thread

import pytest

from ep2sindy._stubs import dotted_names
from tests.browser import seen

SEARCH = "document.querySelector('.md-search, [data-md-component=search]') !== null"
ROOT = Path(__file__).resolve().parents[1]


def test_every_public_name_stands_on_one_page_of_the_reference() -> None:
    pytest.importorskip("mkdocs", reason="the site's tools come with the extra `docs`")
    pages = run_path(str(ROOT / "docs" / "site.py"))["reference"]()
    assert sorted(name for names in pages.values() for name in names) == sorted(dotted_names())
    assert all(pages)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Its address."""
    pytest.importorskip("mkdocs", reason="the site's tools come with the extra `docs`")
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--site-dir", folder]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    assert not re.search(r"^(WARNING|ERROR)", result.stderr, re.MULTILINE), result.stderr
    handler = partial(SimpleHTTPRequestHandler, directory=str(folder))
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


@pytest.mark.slow
@pytest.mark.parametrize("width_px", [1280, 390])
@pytest.mark.parametrize(
    "page",
    [
        "index",
        "tutorial",
        "reference/data",
    ],
)
def test_a_page_reads_at_both_widths_and_asks_for_nothing_outside(
    site: str, page: str, width_px: int
) -> None:
    found = seen(f"{site}/{page}.html", width_px, questions={"search": SEARCH})
    assert not [url for url in found.asked if not url.startswith((site, "data:", "blob:"))]
    assert not found.console
    assert found.scroll_px <= width_px
    assert not found.empty
    assert found.answers["search"]
