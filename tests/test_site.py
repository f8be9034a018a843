"""The documentation site in a real browser, as `make site` builds it."""

import functools
import http.server
import shutil
import threading
from pathlib import Path

import pytest

from tests.browser import Browser

SITE = Path(__file__).parents[1] / "build" / "site"
pytestmark = pytest.mark.skipif(
    not SITE.exists() or not shutil.which("chromedriver"), reason="needs the site (make site) and chromedriver"
)


class Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, *_):
        """Nothing."""


@pytest.fixture(scope="module")
def address():
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Quiet, directory=str(SITE)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}"
    server.shutdown()
    server.server_close()


def test_pages_show_their_pictures_formulas_and_references_without_a_message_in_the_console(address):
    with Browser() as browser:
        browser.open(f"{address}/index.html")
        browser.wait_for("return [...document.images].length >= 2 && [...document.images].every(i => i.naturalWidth > 100)")
        assert browser.run("return document.title") == "sb3_flock"
        browser.open(f"{address}/method/")
        assert browser.run("return document.querySelectorAll('math').length") > 50
        assert browser.run("return document.querySelector('math[display=block]').getBoundingClientRect().height") > 15
        assert "FORMULA" not in browser.run("return document.body.innerText")
        browser.open(f"{address}/reference/learning/")
        for name in ("make_vec_env", "FlockCNN", "NeighborInclusiveReward"):
            assert name in browser.run("return [...document.querySelectorAll('h2')].map(h => h.innerText).join(' ')")
        browser.open(f"{address}/python_api/")
        browser.run("[...document.querySelectorAll('article a')].find(a => a.innerText.includes('train_with_sb3')).click()")
        browser.wait_for("return document.body.innerText.includes('NormalActionNoise')")
        assert browser.console() == []
