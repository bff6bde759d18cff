"""The page on a phone, measured in headless Chromium, where there is one."""

import json
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from jaxdeconf.report.run import write_report

CHROMIUM = next(filter(None, map(shutil.which, ["chromium", "chromium-browser", "chrome"])), None)
WIDTH = 390
MEASURE = """<script>
const wide = [...document.querySelectorAll(".wide")], images = [...document.images];
const before = images.map(image => image.clientWidth);
const page = document.documentElement.scrollWidth;
for (const details of document.querySelectorAll("figure details")) details.open = true;
document.title = JSON.stringify({
  window: window.innerWidth,
  page: page,
  opened: document.documentElement.scrollWidth,
  tables: wide.map(table => [table.clientWidth, table.scrollWidth]),
  shades: wide.map(table => getComputedStyle(table).backgroundImage),
  images: images.map((image, i) => [before[i], image.clientWidth, image.naturalWidth]),
  text: [...document.querySelectorAll("td, th, p, figcaption")].map(
    element => parseFloat(getComputedStyle(element).fontSize)),
});
</script>"""


@pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium")
def test_tables_scroll_pictures_open_and_labels_are_readable(make, brief, tmp_path: Path):
    write_report(tmp_path, make(), brief)
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    (tmp_path / "measured.html").write_text(page.replace("</body>", MEASURE + "</body>"), "utf-8")
    flags = ("--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={tmp_path / 'own'}")
    done = subprocess.run(
        [
            str(CHROMIUM),
            *flags,
            f"--window-size={WIDTH},844",
            "--virtual-time-budget=5000",
            "--dump-dom",
            (tmp_path / "measured.html").as_uri(),
        ],
        capture_output=True,
        text=True,
        timeout=120,
    )
    title = re.search(r"<title>(.*?)</title>", done.stdout)
    assert title is not None, done.stderr
    found = json.loads(title[1])
    assert found["page"] <= found["window"]  # only tables and opened pictures move sideways
    assert found["opened"] <= found["window"]
    scrolling = [inner > outer for outer, inner in found["tables"]]
    assert any(scrolling)
    assert all("linear-gradient" in shade for shade in found["shades"])  # that there is more
    assert all(shown <= found["window"] for shown, _, _ in found["images"])
    assert all(opened == own for _, opened, own in found["images"])
    assert min(found["text"]) >= 12
