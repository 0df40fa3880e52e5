"""A diagnosis as one HTML file: figures as SVG, equations as MathML, no scripts, nothing loaded from elsewhere.

Figures are drawn with matplotlib in stand-in colours that the style sheet then sets, so that they follow a light or a dark screen.
Every text that may come from a file is escaped, and the page's own policy lets no script run.
"""

from __future__ import annotations

import io
import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from latticebench.bench.report import mathml, report
from latticebench.systems.files import write_text

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from latticebench.diagnosis.repair import Diagnosis, Round
    from latticebench.diagnosis.residual import Forecast

# Stand-in colours of the figures and what the style sheet calls them.
INK, BEFORE, AFTER, FAINT = "#010101", "#020202", "#030303", "#040404"
STYLES = {INK: "currentColor", BEFORE: "var(--before)", AFTER: "var(--after)", FAINT: "var(--line)"}
MORE, LESS = (0.80, 0.20, 0.18), (0.13, 0.42, 0.80)
# Columns of a map and points of a line: more cannot be seen.
COLUMNS, POINTS = 400, 1200
# Chains shorter than this are drawn as lines: a map would have too few rows.
MAPPED = 4
WIDTH, HEIGHT = 5.0, 3.0

STYLE = """
:root { color-scheme: light dark; --page: #fbfbfa; --card: #ffffff; --ink: #1d2126; --dim: #5c6570; --line: #d9dde2;
  --before: #c2571a; --after: #1f66c1; --good: #1a7f4b; --bad: #b3261e; --unsure: #946200; }
@media (prefers-color-scheme: dark) { :root { --page: #14171a; --card: #1d2125; --ink: #e8eaed; --dim: #a2abb5; --line: #3a4148;
  --before: #f0985f; --after: #74aef5; --good: #63cf97; --bad: #ff8a80; --unsure: #e5b94f; } }
* { box-sizing: border-box; }
body { margin: 0; background: var(--page); color: var(--ink); font: 16px/1.5 system-ui, -apple-system, "Segoe UI", sans-serif; }
main { max-width: 1080px; margin: 0 auto; padding: 24px 16px 48px; }
h1 { font-size: 1.55rem; line-height: 1.25; margin: 8px 0 12px; text-wrap: balance; }
h2 { font-size: 1.1rem; margin: 0 0 10px; }
h3 { font-size: .95rem; margin: 0 0 6px; color: var(--dim); font-weight: 600; }
p { margin: 6px 0; }
section { background: var(--card); border: 1px solid var(--line); border-radius: 10px; padding: 16px 18px; margin: 14px 0; }
.dim, figcaption, th { color: var(--dim); }
.badge { display: inline-block; border-radius: 99px; padding: 2px 12px; font-size: .85rem; font-weight: 600; border: 1.5px solid; }
.good { color: var(--good); } .bad { color: var(--bad); } .unsure { color: var(--unsure); }
.facts { display: flex; flex-wrap: wrap; gap: 4px 20px; color: var(--dim); font-size: .92rem; padding: 0; margin: 0; list-style: none; }
.name { overflow-wrap: anywhere; }
.pair { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 400px), 1fr)); gap: 16px 28px; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: .94rem; font-variant-numeric: tabular-nums; }
th { font-weight: 600; text-align: left; }
th, td { padding: 4px 18px 4px 0; vertical-align: top; border-bottom: 1px solid var(--line); }
tr:last-child td { border-bottom: 0; }
td.number, th.number { text-align: right; } td.number { white-space: nowrap; } th { vertical-align: bottom; }
td.after { font-weight: 600; }
figure { margin: 0; }
figure svg { display: block; width: 100%; max-width: 620px; height: auto; }
figure svg text { font-family: system-ui, -apple-system, "Segoe UI", "DejaVu Sans", sans-serif !important; }
figcaption { font-size: .88rem; }
.equation { display: block; margin-bottom: 6px; line-height: 2.1; font-size: 1.12rem; }
math { font-family: "STIX Two Math", "Latin Modern Math", "Cambria Math", "Noto Sans Math", math; }
math.added { color: var(--after); }
.lines { margin: 4px 0 0; padding-left: 20px; }
.lines li { color: var(--after); }
.bars { width: 100%; table-layout: fixed; }
.bars td { padding-right: 10px; border: 0; overflow-wrap: anywhere; }
.bars .what { width: 42%; } .bars .e { width: 52px; text-align: right; } .bars .p { width: 82px; text-align: right; padding-right: 0; white-space: nowrap; }
.bar { height: 12px; margin-top: 6px; border-radius: 3px; background: var(--dim); opacity: .45; min-width: 2px; }
.chosen .bar { background: var(--after); opacity: 1; } .chosen .what { font-weight: 600; } .alike .bar { background: var(--after); opacity: .6; }
.scale { height: 10px; border-radius: 3px; border: 1px solid var(--line); margin-top: 8px; max-width: 320px; }
.marks { display: flex; justify-content: space-between; max-width: 320px; font-size: .82rem; color: var(--dim); }
.key::before { content: ""; display: inline-block; width: 18px; height: 3px; margin: 0 6px 3px 0; background: currentColor; border-radius: 2px; }
.key { margin-right: 18px; white-space: nowrap; } .key.b { color: var(--before); } .key.a { color: var(--after); }
.key.dot::before { height: 7px; width: 7px; border-radius: 50%; margin-bottom: 1px; }
details summary { cursor: pointer; color: var(--dim); }
code { font: .92em ui-monospace, "DejaVu Sans Mono", monospace; overflow-wrap: anywhere; }
dl { display: grid; grid-template-columns: max-content 1fr; gap: 2px 14px; font-size: .88rem; margin: 8px 0 0; }
dt { color: var(--dim); } dd { margin: 0; overflow-wrap: anywhere; }
@media (max-width: 520px) { main { padding: 12px 10px 32px; } section { padding: 13px 12px; } h1 { font-size: 1.3rem; }
  th, td { padding-right: 10px; } dl { grid-template-columns: 1fr; } dt { margin-top: 6px; } }
@media print { section { break-inside: avoid; } }
"""

MOODS = {"nothing missing": "good", "explained": "good", "partly explained": "unsure", "unexplained": "bad"}


def write_page(diagnosis: Diagnosis, about: Mapping[str, Any], path: Path) -> None:
    """Write the page of a diagnosis, whole or not at all.

    Args:
        diagnosis: what the loop found.
        about: the command, seed, commit, machine and versions behind it, see `bench.provenance`.
        path: the file.

    Raises:
        InputError: it cannot be written.
    """
    write_text(path, page(diagnosis, about))


def page(diagnosis: Diagnosis, about: Mapping[str, Any]) -> str:
    """Make the page of a diagnosis; `about` as for `write_page`."""
    sections = [
        _head(diagnosis), _equations(diagnosis), _effects(diagnosis), _errors(diagnosis), _residual(diagnosis), _causes(diagnosis),
        _forecast(diagnosis), _notes(diagnosis), _origin(about),
    ]  # fmt: skip
    policy = "default-src 'none'; style-src 'unsafe-inline'; img-src data:; base-uri 'none'; form-action 'none'"
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>Diagnosis: {escape(diagnosis.course.verdict)}</title>\n<style>{STYLE}</style>\n</head>\n<body>\n<main>\n"
        + "\n".join(one for one in sections if one)
        + "\n</main>\n</body>\n</html>\n"
    )


# Sections -------------------------------------------------------------------------------------------------------------------------


def _section(title: str, *inner: str) -> str:
    return f"<section>\n<h2>{escape(title)}</h2>\n" + "\n".join(inner) + "\n</section>"


def _table(columns: Sequence[str], rows: Sequence[Sequence[str]], *, texts: int = 1, strong: int | None = None) -> str:
    """Write a table of plain texts; the first `texts` columns are words, the others numbers."""

    def cell(tag: str, k: int, text: str) -> str:
        kinds = (["number"] if k >= texts else []) + (["after"] if k == strong and tag == "td" else [])
        return f"<{tag}{f' class={chr(34)}' + ' '.join(kinds) + chr(34) if kinds else ''}>{escape(text)}</{tag}>"

    head = "".join(cell("th", k, text) for k, text in enumerate(columns))
    body = "\n".join("<tr>" + "".join(cell("td", k, text) for k, text in enumerate(row)) + "</tr>" for row in rows)
    return f'<div class="wide"><table><thead><tr>{head}</tr></thead><tbody>\n{body}\n</tbody></table></div>'


def _head(diagnosis: Diagnosis) -> str:
    course = diagnosis.course
    data = course.after.data
    sources = list(dict.fromkeys(samples.source for samples in data))
    named = ", ".join(sources[:6]) + (f" and {len(sources) - 6} more" if len(sources) > 6 else "")
    # A dense record may have been thinned and cut into pieces for the fit.
    rows = sum(len(samples.t) for samples in data)
    count = len(report.over_noise(course.after, diagnosis))
    facts = [
        f"{data[0].sites} site{'s' * (data[0].sites != 1)}", f"{rows} rows fitted" + (f" in {count} trajectories" if count > 1 else ""),
        "complex field" if data[0].is_complex else "real field", *([f"ends {data[0].ends}"] if data[0].sites > 1 else []),
        f"noise {report.total_noise(diagnosis):.3g}", f"residual {diagnosis.residual[0]:.3g} → {diagnosis.residual[1]:.3g} × noise",
    ]  # fmt: skip
    listed = "".join(f"<li>{escape(fact)}</li>" for fact in facts)
    return (
        f'<header>\n<span class="badge {MOODS.get(course.verdict, "unsure")}">{escape(course.verdict)}</span>\n'
        f'<h1>{escape(report.sentence(diagnosis))}</h1>\n<p class="name">{escape(named)}</p>\n<ul class="facts">{listed}</ul>\n</header>'
    )


def _equations(diagnosis: Diagnosis) -> str:
    course = diagnosis.course
    inner = []
    for name, fitted in (("Declared", course.before), ("With what was found", course.after)):
        if fitted is course.after and not fitted.model.changes:
            continue
        lines = "".join(f"<li>{escape(line)}</li>" for line in report.elsewhere(fitted))
        inner.append(
            f"<h3>{name}</h3>\n{mathml.equation(fitted)}" + (f'\n<ul class="lines">{lines}</ul>' if lines else "")
        )
    before, _ = report.declared(course.before)
    after, errors = report.declared(course.after)
    columns = ["declared term", "before", "after", "standard error"]
    rows = [[text, f"{before[text]:.6g}", f"{after[text]:.6g}", f"{errors[text]:.2g}"] for text in after]
    if diagnosis.truth is not None:
        columns.append("truth")
        rows = [[*row, f"{value:.6g}"] for row, value in zip(rows, diagnosis.truth, strict=True)]
    return _section(
        "The equation", *inner, "<h3 style='margin-top:14px'>Coefficients</h3>", _table(columns, rows, strong=2)
    )


def _effects(diagnosis: Diagnosis) -> str:
    rows = []
    for one in report.added(diagnosis):
        numbers = {**{k: v for k, v in one.parameters.items() if k not in ("open", "reach")}, **one.coefficients}
        for name, value in list(numbers.items())[: report.LISTED + 2]:
            error = one.stderr.get(name)
            shown = f"{value:.5g}" if isinstance(value, float) else str(value)
            rows.append([one.effect, name, shown, "" if error is None else f"{error:.2g}"])
        if len(numbers) > report.LISTED + 2:
            rows.append([one.effect, f"… and {len(numbers) - report.LISTED - 2} more (all are in the JSON)", "", ""])
    if not rows:
        return ""
    apart = [
        f"<li><b>{escape(first)}</b> cannot be told from <b>{escape(second)}</b> on these data. What would separate them: {escape(said)}.</li>"
        for first, second, said in report.separations(diagnosis)
    ]
    inner = [_table(["effect", "what", "value", "standard error"], rows, texts=2)]
    if apart:
        inner.append(f"<h3 style='margin-top:14px'>What cannot be told apart</h3><ul>{''.join(apart)}</ul>")
    return _section("What was added", *inner)


def _errors(diagnosis: Diagnosis) -> str:
    return _section(
        "Errors", _table(["", "before", "after"], [list(row) for row in report.errors(diagnosis)], strong=2)
    )


def _residual(diagnosis: Diagnosis) -> str:
    course = diagnosis.course
    cured = bool(course.after.model.changes)
    sides = [("before", course.before)] + ([("after", course.after)] if cured else [])
    every = {name: report.over_noise(fitted, diagnosis) for name, fitted in sides}
    # The trajectory, and of u and v the one, that shows more.
    number = int(np.argmax([float(np.nanmean(values**2)) for _, values in every["before"]]))
    times = {name: found[number][0] for name, found in every.items()}
    left = {name: found[number][1] for name, found in every.items()}
    power = np.nan_to_num(left["before"]) ** 2
    counts = np.sum(np.isfinite(left["before"]), axis=(0, 2, 3))
    level = int(np.argmax(np.sum(power, axis=(0, 2, 3)) / np.maximum(counts, 1)))
    reading = "uv"[level]
    shown = {name: values[:, level] for name, values in left.items()}
    limit = _limit(shown["before"])
    span = "" if left["before"].shape[-1] not in range(2, MAPPED) else f"; full swing is {limit:.2g} times the noise"
    figures = []
    for name, values in shown.items():
        title = {"before": "Before", "after": "After"}[name]
        drawing = (
            _map(times[name], values, limit)
            if values.shape[-1] >= MAPPED
            else _traces(times[name], values, limit, BEFORE if name == "before" else AFTER)
        )
        figures.append(
            _figure(
                f"{title}: residual of {reading}, site against time",
                drawing,
                f"map-{name}",
                f"{title}, readings of {reading}{span}",
            )
        )
    lead = (
        ""
        if len(every["before"]) == 1
        else f'<p class="dim">Trajectory {number + 1} of {len(every["before"])}, where it is largest.</p>'
    )
    complex_ = course.before.data[0].is_complex
    inner = [lead, f'<div class="pair">{"".join(figures)}</div>']
    if course.before.data[0].sites >= MAPPED:
        inner.append(_colours(limit, complex_))
    lines = [
        (colour, *report.spectrum(times[name], left[name])[:2])
        for name, colour in (("before", BEFORE), ("after", AFTER))
        if name in left
    ]
    found = [change.psi["omega"] for change in course.after.model.changes if "omega" in change.psi]
    spectrum = _figure(
        "Spectrum of the residual before and after", _spectrum(lines, found), "spectrum",
        'Spectrum, mean over all readings; 1 is noise. <span class="key b">before</span>' + ('<span class="key a">after</span>' if cured else ""),
    )  # fmt: skip
    said = [
        f"<h3>Where it lives{' before' if cured else ''}</h3>",
        *_paragraphs(report.living(report.whereabouts(course.before, diagnosis))),
    ]
    if cured:
        said += ["<h3>After</h3>", *_paragraphs(report.living(report.whereabouts(course.after, diagnosis)))]
    inner.append(f'<div class="pair" style="margin-top:18px">{spectrum}<div>{"".join(said)}</div></div>')
    return _section("The residual, in units of the noise", *inner)


def _paragraphs(lines: Sequence[str]) -> list[str]:
    return [f"<p>{escape(line)}</p>" for line in lines]


def _causes(diagnosis: Diagnosis) -> str:
    every = [
        entry.evidence for turn in diagnosis.course.rounds for entry in turn.ranking if math.isfinite(entry.evidence)
    ]
    longest = max([1.0, *every])
    turns = [_bars(number, turn, longest) for number, turn in enumerate(diagnosis.course.rounds, start=1)]
    lead = (
        '<p class="dim">Evidence is how much likelier the data become with the effect (natural logarithm), less what the search for it costs; '
        "p is the chance that noise alone does as well. Entries without a name are no effects of the catalogue.</p>"
    )
    return _section("Ranked causes", lead, f'<div class="pair">{"".join(turns)}</div>')


def _bars(number: int, turn: Round, longest: float) -> str:
    """Draw the ranking of a round; bars of all rounds have one scale."""
    rows = []
    for entry in report.top(turn):
        kind = "chosen" if entry.name == turn.added else "alike" if entry.name in turn.equal else ""
        width = 100 * min(max(entry.evidence, 0.0) / longest, 1.0)
        name = (
            escape(entry.name)
            if entry.finding.named
            else f'<span class="dim">no name:</span> <code>{escape(entry.name)}</code>'
        )
        rows.append(
            f'<tr class="{kind}"><td class="what">{name}</td><td><div class="bar" style="width:{width:.1f}%" '
            f'title="evidence {entry.evidence:.1f}"></div></td><td class="e">{entry.evidence:.{1 if abs(entry.evidence) < 100 else 0}f}</td>'
            f'<td class="p dim">{escape("p " + report.chance(entry.p))}</td></tr>'
        )
    result = f"added {escape(turn.added)}" if turn.added else "nothing added"
    return f'<div><h3>Round {number}: {result}</h3><table class="bars"><tbody>{"".join(rows)}</tbody></table></div>'


def _forecast(diagnosis: Diagnosis) -> str:
    before, after = (_joined(side) for side in diagnosis.forecasts)
    cured = bool(diagnosis.course.after.model.changes)
    moving = diagnosis.course.after.records[0].stretches.dynamics.moving
    # A forecast that ran away is the worst; a site that was not read cannot be.
    sizes = [np.nan_to_num(_rms(one, moving, (0, 1)), nan=-1.0, posinf=1e300) for one in before]
    number = int(np.argmax([np.max(size) for size in sizes]))
    first = range(before[number].seen.shape[-1])[moving][0]
    site = first + int(np.argmax(sizes[number]))
    drawing = _prediction(before[number], after[number] if cured else None, site)
    where = f"site {site + 1}" + (f" of trajectory {number + 1}" if len(before) > 1 else "")
    part = ", real part" if before[number].seen.shape[1] > 1 else ""
    keys = '<span class="key b">declared</span>' + ('<span class="key a">with what was found</span>' if cured else "")
    caption = f'The site that the declared equation predicts worst: {where}{part}. <span class="key dot">readings</span>{keys}'
    growth = _growth(before[number], after[number] if cured else None, moving, float(diagnosis.noise[0]))
    return _section(
        "Forecast of data that were not fitted", '<div class="pair">',
        _figure("Forecast against readings", drawing, "forecast", caption),
        _figure("Error of the forecast against time", growth, "growth", f"Its error over all sites, in units of the noise. {keys}"),
        "</div>",
    )  # fmt: skip


def _notes(diagnosis: Diagnosis) -> str:
    said = report.notes(diagnosis)
    return _section("Notes", *_paragraphs(said)) if said else ""


def _origin(about: Mapping[str, Any]) -> str:
    from latticebench.bench.provenance import lines

    entries = "".join(
        f"<dt>{escape(name)}</dt><dd>{escape(value)}</dd>"
        for name, _, value in (line.partition(": ") for line in lines(about))
    )
    return (
        f"<section>\n<details><summary>How this page was made</summary><dl>{entries}</dl></details>\n</section>"
        if entries
        else ""
    )


# Figures --------------------------------------------------------------------------------------------------------------------------


def _figure(label: str, drawing: str, name: str, caption: str) -> str:
    """Put a drawing on the page; `caption` is HTML of our own."""
    drawing = drawing.replace("<svg ", f'<svg role="img" aria-label="{escape(label)}" ', 1)
    return f'<figure id="{name}">{drawing}<figcaption>{caption}</figcaption></figure>'


def _axes() -> tuple[Figure, Axes]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(WIDTH, HEIGHT), layout="constrained")
    axes = figure.add_subplot()
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    for spine in axes.spines.values():
        spine.set_color(FAINT)
    axes.tick_params(colors=INK, labelsize=11)
    axes.xaxis.label.set_color(INK)
    axes.yaxis.label.set_color(INK)
    axes.xaxis.label.set_fontsize(12)
    axes.yaxis.label.set_fontsize(12)
    return figure, axes


def _svg(figure: Figure, salt: str) -> str:
    """Write a figure as an SVG element that takes its colours from the page."""
    import matplotlib as mpl

    written = io.StringIO()
    # Letters stay letters: they can be searched, read aloud, and follow the page's font.
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": salt}):
        figure.savefig(
            written,
            format="svg",
            transparent=True,
            metadata={"Date": None, "Creator": None, "Format": None, "Type": None},
        )
    text = written.getvalue()
    text = text[text.index("<svg ") :]
    for colour, style in STYLES.items():
        text = text.replace(colour, style)
    begin = text.index(">")
    words = [word for word in text[:begin].split(" ") if not word.startswith(("width=", "height=", "version="))]
    return " ".join(words) + text[begin:]


def _limit(left: np.ndarray) -> float:
    """Give the end of the colour scale: all but the few largest values are within it."""
    seen = np.abs(left[np.isfinite(left)])
    return max(3.0, float(np.quantile(seen, 0.995))) if len(seen) else 3.0


def _map(t: np.ndarray, left: np.ndarray, limit: float) -> str:
    """Draw a residual (T, parts, N), site against time; nothing left is transparent."""
    from matplotlib.ticker import MaxNLocator

    signed = left[:, 0] if left.shape[1] == 1 else np.sqrt(np.mean(left**2, axis=1))
    columns = min(len(t), COLUMNS)
    shown = np.full((columns, signed.shape[1]), np.nan)
    # Columns are evenly spaced even where times are not: each shows the largest value near it.
    near = np.linspace(t[0], t[-1], columns)
    owner = np.clip(np.round((t - t[0]) / (t[-1] - t[0]) * (columns - 1)).astype(int), 0, columns - 1)
    for column in range(columns):
        rows = np.flatnonzero(owner == column)
        if not len(rows):
            rows = np.array([int(np.argmin(np.abs(t - near[column])))])
        block = signed[rows]
        largest = np.argmax(np.nan_to_num(np.abs(block), nan=-1.0), axis=0)
        shown[column] = block[largest, np.arange(block.shape[1])]
    values = shown.T
    image = np.zeros((*values.shape, 4))
    image[..., :3] = np.where((values >= 0)[..., None], MORE, LESS)
    image[..., 3] = np.minimum(np.nan_to_num(np.abs(values)) / limit, 1.0)
    image[~np.isfinite(values)] = (0.5, 0.5, 0.5, 0.25)
    figure, axes = _axes()
    half = (t[-1] - t[0]) / max(columns - 1, 1) / 2
    axes.imshow(
        image, aspect="auto", origin="lower", interpolation="none",
        extent=(t[0] - half, t[-1] + half, 0.5, values.shape[0] + 0.5),
    )  # fmt: skip
    axes.set_xlabel("t")
    axes.set_ylabel("site")
    axes.yaxis.set_major_locator(MaxNLocator(integer=True))
    return _svg(figure, f"map {float(np.nansum(np.abs(values))):.6g}")


def _colours(limit: float, is_complex: bool) -> str:
    more, less = (f"rgb({','.join(str(round(255 * part)) for part in colour)})" for colour in (MORE, LESS))
    if is_complex:
        gradient, marks = f"transparent, {more}", ("0", "size of the residual", f"{limit:.2g} × noise")
    else:
        gradient, marks = f"{less}, transparent, {more}", (f"−{limit:.2g} × noise", "0", f"+{limit:.2g}")
    spans = "".join(f"<span>{mark}</span>" for mark in marks)
    return f'<div class="scale" style="background:linear-gradient(90deg, {gradient})"></div><div class="marks">{spans}</div>'


def _thinned(t: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Keep the smallest and the largest value of each stretch of a long line."""
    if len(t) <= POINTS:
        return t, values
    edges = np.linspace(0, len(t), POINTS // 2 + 1).astype(int)
    kept = []
    for begin, end in itertools.pairwise(edges):
        block = np.nan_to_num(values[begin:end], nan=0.0)
        kept += sorted({begin + int(np.argmin(block)), begin + int(np.argmax(block))})
    return t[kept], values[kept]


def _traces(t: np.ndarray, left: np.ndarray, limit: float, colour: str) -> str:
    """Draw the residual (T, parts, N) of a few sites as lines, one above the other."""
    figure, axes = _axes()
    gap = 2.2 * limit
    sites = left.shape[-1]
    for site in range(sites):
        for part in range(left.shape[1]):
            x, y = _thinned(t, left[:, part, site])
            axes.plot(
                x,
                np.clip(y, -limit, limit) + gap * (sites - 1 - site),
                color=colour,
                linewidth=0.8,
                alpha=1.0 if part == 0 else 0.6,
            )
    axes.set_ylim(-gap / 2, gap * (sites - 0.5))
    centres = [gap * (sites - 1 - site) for site in range(sites)]
    if sites == 1:
        axes.set_ylabel("residual / noise")
    else:
        axes.set_yticks(centres, [f"site {site + 1}" for site in range(sites)])
    axes.set_xlabel("t")
    return _svg(figure, f"traces {colour}")


def _spectrum(lines: Sequence[tuple[str, np.ndarray, np.ndarray]], found: Sequence[float]) -> str:
    from matplotlib.ticker import LogLocator, NullLocator

    figure, axes = _axes()
    lowest, highest = 1.0, 1.0
    for colour, omega, power in lines:
        x, y = omega, np.maximum(power, 1e-3)
        if len(x) > COLUMNS:
            edges = np.unique(np.linspace(0, len(x), COLUMNS + 1).astype(int))
            # The lines of a spectrum must not be averaged away.
            x, y = (x[edges[:-1]] + x[edges[1:] - 1]) / 2, np.maximum.reduceat(y, edges[:-1])
        axes.plot(x, y, color=colour, linewidth=1.8)
        if len(y):
            lowest, highest = min(lowest, float(np.min(y))), max(highest, float(np.max(y)))
    for line in found:
        axes.axvline(line, color=AFTER, linewidth=1, linestyle=":")
    axes.axhline(1.0, color=INK, linewidth=0.8, linestyle="--")
    # Powers of ten as plain numbers: superscripts would need a font that a browser may lack.
    axes.set_yscale("log")
    axes.set_ylim(lowest / 1.5, highest * 1.5)
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if highest < 100 * lowest else (1.0,)))
    axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.yaxis.set_minor_locator(NullLocator())
    axes.set_xlabel("angular frequency")
    axes.set_ylabel("power / noise")
    return _svg(figure, "spectrum")


def _joined(forecasts: Sequence[Forecast]) -> list[Forecast]:
    """Put the forecasts of pieces of one trajectory together, with gaps between them."""
    found: list[Forecast] = []
    for one in forecasts:
        if not found or one.t[0] <= found[-1].t[-1]:
            found.append(one)
            continue
        last = found[-1]
        gap = np.full_like(last.seen[:1], np.nan)
        found[-1] = replace(
            last,
            t=np.concatenate([last.t, [(last.t[-1] + one.t[0]) / 2], one.t]),
            seen=np.concatenate([last.seen, gap, one.seen]),
            predicted=np.concatenate([last.predicted, gap, one.predicted]),
        )
    return found


def _prediction(before: Forecast, after: Forecast | None, site: int) -> str:
    figure, axes = _axes()
    sides = [(one, *kind) for one, kind in ((before, (BEFORE, "--")), (after, (AFTER, "-"))) if one is not None]
    seen = np.concatenate([one.seen[:, 0, site] for one, _, _ in sides])
    seen = seen[np.isfinite(seen)]
    low, high = (float(np.min(seen)), float(np.max(seen))) if len(seen) else (-1.0, 1.0)
    # A forecast that runs away must not hide the readings.
    room = 0.6 * (high - low) + 1e-12
    for one, _, _ in sides:
        t, values = _thinned(one.t, one.seen[:, 0, site])
        dense = len(one.t) > 150
        style = "-" if len(one.t) > POINTS else "o"
        axes.plot(t, values, style, color=INK, markersize=2.0 if dense else 4.0, linewidth=0.8)
    for one, colour, style in sides:
        t, values = _thinned(one.t, np.clip(one.predicted[:, 0, site], low - 2 * room, high + 2 * room))
        axes.plot(t, values, style, color=colour, linewidth=1.8)
    axes.set_ylim(low - room, high + room)
    axes.set_xlabel("t")
    axes.set_ylabel(f"u at site {site + 1}")
    return _svg(figure, "forecast")


def _rms(one: Forecast, moving: slice, axis: tuple[int, int]) -> np.ndarray:
    """Give the RMS of a forecast's error at the sites that have an equation; NaN where nothing was read."""
    seen = np.isfinite(one.seen[..., moving])
    with np.errstate(all="ignore"):
        wrong = np.square(one.seen - one.predicted)[..., moving]
        return np.asarray(np.sqrt(np.sum(np.where(seen, wrong, 0.0), axis=axis) / np.sum(seen, axis=axis)))


def _growth(before: Forecast, after: Forecast | None, moving: slice, sigma: float) -> str:
    """Draw how the forecast's error over all sites grows."""
    figure, axes = _axes()
    highest = 1.0
    for one, colour, style in ((before, BEFORE, "--"), (after, AFTER, "-")):
        if one is None:
            continue
        size = _rms(one, moving, (1, 2)) / sigma
        size = np.minimum(np.where(np.isfinite(size), size, np.nan), 1e6)
        axes.plot(*_thinned(one.t, size), style, color=colour, linewidth=1.8)
        highest = max(highest, float(np.nanmax(size)) if np.any(np.isfinite(size)) else 1.0)
    axes.axhline(1.0, color=INK, linewidth=0.8, linestyle="--")
    axes.set_ylim(0, 1.08 * highest)
    axes.set_xlabel("t")
    axes.set_ylabel("error / noise")
    return _svg(figure, "growth")
