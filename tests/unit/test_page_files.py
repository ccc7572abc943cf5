"""The page's own files: what has to be in sight wherever one has scrolled to."""

import re
from pathlib import Path

import pytest

STATIC = Path("gateway/operator/page/static")


@pytest.mark.parametrize("name", ["stop", "stale", "reply"])
def test_stop_and_what_came_of_it_are_in_the_part_that_does_not_scroll_away(name: str):
    page = (STATIC / "index.html").read_text()
    top = page[page.index('<header id="top">') : page.index("</header>")]
    assert f'id="{name}"' in top and page.count(f'id="{name}"') == 1
    assert re.search(r"#top \{[^}]*position: sticky", (STATIC / "page.css").read_text())


def test_what_goes_into_an_open_window_is_what_the_page_has():
    taken = re.search(r"const WITH_IT = \[(.*?)\]", (STATIC / "dialog.js").read_text())
    assert taken is not None and re.findall(r'"(\w+)"', taken[1]) == ["stop", "stale", "reply"]
