"""The pages of a site in a browser, as wide as a desktop and as a phone."""

from __future__ import annotations

import html
import json
import re
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from latticebench.bench.published import read_head

BROWSER = next(
    (found for name in ("chromium", "chromium-browser", "google-chrome") if (found := shutil.which(name))), None
)
DESKTOP, PHONE = (1280, 900), (390, 844)
# So many pages are opened at once.
TOGETHER = 16

# Every text that is shown has its contrast to what is behind it, and a place.
LOOK = """
const shown = (one) => one.checkVisibility() && one.getClientRects().length;
const parts = (colour) => (colour.match(/[\\d.]+/g) ?? []).map(Number);
const known = new Map();
const behind = (one) => {
  if (!one) return [255, 255, 255];
  if (!known.has(one)) {
    const [r, g, b, a = 1] = parts(getComputedStyle(one).backgroundColor);
    known.set(one, a > 0.99 ? [r, g, b] : behind(one.parentElement));
  }
  return known.get(one);
};
const light = (colour) => {
  const [r, g, b] = colour.map((c) => c / 255).map((c) => (c <= 0.03928 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4));
  return 0.2126 * r + 0.7152 * g + 0.0722 * b;
};
const contrast = (a, b) => {
  const [less, more] = [light(a), light(b)].sort((p, q) => p - q);
  return (more + 0.05) / (less + 0.05);
};
const texts = [...document.querySelectorAll('body *')].filter((one) => shown(one) &&
  [...one.childNodes].some((node) => node.nodeType === 3 && node.data.trim()));
const styles = new Map();
for (const one of texts) {
  const style = getComputedStyle(one), colour = one instanceof SVGElement ? style.fill : style.color;
  const found = contrast(parts(colour).slice(0, 3), behind(one));
  styles.set(`${one.tagName} ${one.className?.baseVal ?? one.className} ${colour}`, found);
}
const beyond = texts.filter((one) => !one.closest('.wide, pre') && one.getBoundingClientRect().right > innerWidth + 1);
return {
  window: innerWidth, wide: document.documentElement.scrollWidth,
  beyond: beyond.map((one) => one.outerHTML.slice(0, 200)),
  poor: [...styles].filter(([, found]) => found < 4.5), styles: styles.size,
  dark: light(behind(document.body)) < 0.2, unnamed: [...document.querySelectorAll('table')].filter(
    (one) => !one.caption && !one.ariaLabel && !one.closest('.prose')).length,
  headings: document.querySelectorAll('h1').length,
};
"""

USE = """
const rows = () => [...document.querySelector('table').tBodies[0].rows].filter((row) => !row.hidden);
const heads = [...document.querySelector('table').tHead.rows[0].cells].map((one) => one.innerText.trim());
const cells = (name) => rows().map((row) => row.cells[heads.indexOf(name)].textContent);
const change = (one) => one.dispatchEvent(new Event('change'));
const points = () => document.querySelectorAll('.drawn .point').length;
const found = { all: rows().length, points: points() };
const system = document.querySelector('select[data-column=system]');
system.value = 2; change(system);
found.system = system.selectedOptions[0].textContent;
found.systems = [...new Set(cells('system'))];
found.chosen = rows().length; found.pointsChosen = points();
found.count = document.querySelector('[role=status]').textContent;
const head = document.querySelectorAll('thead button')[heads.indexOf('E2')];
head.click(); found.up = cells('E2'); found.sorted = head.parentElement.ariaSort;
head.click(); found.down = cells('E2');
system.value = ''; change(system);
const tick = document.querySelector('input[data-method]');
tick.checked = false; change(tick);
found.hidden = tick.dataset.method; found.methods = [...new Set(cells('method'))];
const search = document.querySelector('input[type=search]');
search.value = 'lib2 sr3'; search.dispatchEvent(new Event('input'));
found.searched = [...new Set(cells('library'))].concat([...new Set(cells('method'))]);
search.value = ''; search.dispatchEvent(new Event('input'));
const axis = document.querySelector('select[data-axis^=vertical]');
axis.value = 'tpr'; change(axis); found.pointsOfOther = points();
const figure = document.querySelector('.drawn svg');
const press = (key) => figure.dispatchEvent(new KeyboardEvent('keydown', { key }));
found.reachable = figure.tabIndex;
press('ArrowRight'); found.first = document.querySelector('output').textContent;
press('ArrowRight'); press('ArrowRight'); found.later = document.querySelector('output').textContent;
press('Enter'); found.told = document.querySelector('dialog[open]')?.innerText ?? '';
document.querySelector('dialog button').click(); found.closed = !document.querySelector('dialog[open]');
document.querySelector('a.how').click(); found.toldOfRow = document.querySelector('dialog[open]')?.innerText ?? '';
return found;
"""


def browsed(path: Path, profile: Path, size: tuple[int, int]) -> tuple[str, list[str]]:
    """Open a page in a browser without a window; return its document and what it says on its console."""
    if BROWSER is None:
        pytest.skip("there is no Chromium; install Debian's package chromium")
    command = [
        BROWSER, "--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={profile}",
        f"--window-size={size[0]},{size[1]}", "--virtual-time-budget=3000", "--enable-logging=stderr", "--v=0",
        "--dump-dom", path.as_uri(),
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=300)
    if done.returncode != 0 and not done.stdout:
        pytest.skip(f"Chromium does not run here: {done.stderr[-200:]}")
    return done.stdout, [line for line in done.stderr.splitlines() if "CONSOLE" in line]


def framed(pages: Sequence[str], size: tuple[int, int]) -> str:
    """Return a page with others in it, each in a frame: a window cannot be as narrow as a phone, a frame can."""
    frames = (f'<iframe src="{one}" width="{size[0]}" height="{size[1]}" style="border:0"></iframe>' for one in pages)
    return "\n".join(frames)


def measured(
    paths: Sequence[Path], folder: Path, script: str, size: tuple[int, int], *, dark: bool = False
) -> list[dict[str, Any]]:
    """Run a script of the test's own in each of some pages, whose policy against scripts is taken off for it."""
    for number, path in enumerate(paths):
        text = path.read_text(encoding="utf-8")
        base = f'<base href="{path.parent.as_uri()}/">'
        bare = re.sub(r'<meta http-equiv="Content-Security-Policy"[^>]*>', base, text)
        assert bare != text
        if dark:
            bare = bare.replace("@media (prefers-color-scheme: dark)", "@media all")
        run = f"""<script>addEventListener('load', () => setTimeout(() => {{
          const found = () => {{ {script} }};
          const tell = (what) => parent.postMessage(JSON.stringify([{number}, what]), '*');
          try {{ tell(found()); }} catch (error) {{ tell({{ error: String(error.stack) }}); }}
        }}, 200));</script>"""
        (folder / f"inner{number}.html").write_text(bare.replace("</body>", run + "</body>"), encoding="utf-8")
    copy = folder / "page.html"
    inner = [f"inner{number}.html" for number in range(len(paths))]
    copy.write_text(f"""<pre id="measured"></pre><script>const told = []; addEventListener('message', (event) => {{
      told.push(JSON.parse(event.data)); document.querySelector('#measured').textContent = JSON.stringify(told); }});
      </script>{framed(inner, size)}""")
    document, _ = browsed(copy, folder / "profile", size)
    text_found = re.search(r'<pre id="measured">(.*?)</pre>', document, re.DOTALL)
    assert text_found is not None
    told: dict[int, dict[str, Any]] = dict(json.loads(html.unescape(text_found[1])))
    assert sorted(told) == list(range(len(paths)))
    errors = [found["error"] for found in told.values() if "error" in found]
    assert not errors
    return [told[number] for number in range(len(paths))]


def look_right(paths: Sequence[Path], folder: Path, size: tuple[int, int], *, dark: bool = False) -> None:
    for path, found in zip(paths, measured(paths, folder, LOOK, size, dark=dark), strict=True):
        assert found["window"] == size[0], path
        assert found["wide"] <= found["window"], path
        assert not found["beyond"], path
        assert found["styles"] > 3, path
        assert not found["poor"], path
        assert found["dark"] == dark, path
        assert found["unnamed"] == 0, path
        assert found["headings"] == 1, path


def test_a_page_fits_a_desktop_and_a_phone_and_can_be_read_in_light_and_dark(whole_site: Path, tmp_path: Path) -> None:
    paths = [whole_site / "index.html", whole_site / "default" / "index.html"]
    look_right(paths, tmp_path, DESKTOP)
    look_right(paths, tmp_path, PHONE, dark=True)


def test_a_page_with_labels_that_attack_runs_nothing_of_theirs_and_still_works(site: Path, tmp_path: Path) -> None:
    path = site / "mine" / "index.html"
    _, said = browsed(path, tmp_path / "profile", DESKTOP)
    assert said == []
    look_right([path], tmp_path, PHONE)
    (found,) = measured([path], tmp_path, "document.querySelector('a.how').click();"
                     "return {told: document.querySelector('dialog').innerText,"
                     "tags: document.querySelectorAll('b, i, img').length}", DESKTOP)  # fmt: skip
    assert "<script>alert(1)</script>" in found["told"]
    assert "<i>machine</i>" in found["told"]
    assert found["tags"] == 0


def test_what_a_page_complains_of_is_seen(site: Path, tmp_path: Path) -> None:
    page = tmp_path / "page.html"
    page.write_text("<script>console.error('here')</script>")
    around = tmp_path / "around.html"
    around.write_text(framed(["page.html"], DESKTOP))
    for path in (page, around):
        assert browsed(path, tmp_path / "profile", DESKTOP)[1]
    # The policy keeps a script from a page that is not its own.
    own = (site / "mine" / "index.html").read_text()
    page.write_text(own.replace("</body>", "<script>document.title = 'other'</script></body>"))
    document, said = browsed(page, tmp_path / "profile", DESKTOP)
    assert "<title>other" not in document
    assert any("Content Security Policy" in line for line in said)


def test_rows_are_chosen_and_sorted_and_the_figure_follows(whole_site: Path, tmp_path: Path) -> None:
    path = whole_site / "default" / "index.html"
    commit = read_head(Path(__file__).parents[3] / "results" / "default" / "cases.csv")["commit"]
    assert browsed(path, tmp_path / "profile", DESKTOP)[1] == []
    (found,) = measured([path], tmp_path, USE, DESKTOP)
    assert found["systems"] == [found["system"]]
    assert 0 < found["chosen"] < found["all"]
    assert found["count"] == f"{found['chosen']} of {found['all']} rows"
    assert 0 < found["pointsChosen"] <= found["chosen"]
    assert found["pointsChosen"] < found["points"]
    numbers = [float(text) for text in found["up"] if text != "none"]
    assert found["sorted"] == "ascending"
    assert numbers == sorted(numbers)
    assert len(set(numbers)) > 3
    down = [float(text) for text in found["down"] if text != "none"]
    assert down == numbers[::-1] or down == sorted(numbers, reverse=True)
    assert found["hidden"] not in found["methods"]
    assert len(found["methods"]) > 2
    assert found["searched"] == ["lib2", "lib2-even", "sr3"]
    assert found["pointsOfOther"] > 0
    assert found["reachable"] == 0
    assert "E2" in found["first"] or "support" in found["first"]
    assert found["first"] != found["later"]
    for told in (found["told"], found["toldOfRow"]):
        for text in ("latticebench run default", commit, "AMD EPYC", "seeds", "settings"):
            assert text in told
    assert found["closed"]


@pytest.mark.slow
def test_every_page_loads_without_a_complaint_and_fits_both(whole_site: Path, tmp_path: Path) -> None:
    pages = sorted(whole_site.rglob("*.html"))
    for first in range(0, len(pages), TOGETHER):
        some = pages[first : first + TOGETHER]
        every = tmp_path / "every.html"
        every.write_text(framed([path.as_uri() for path in some], DESKTOP))
        assert browsed(every, tmp_path / "profile", DESKTOP)[1] == []
        look_right(some, tmp_path, DESKTOP)
        look_right(some, tmp_path, PHONE, dark=True)
