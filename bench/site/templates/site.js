"use strict";
// Sorting, choosing and drawing the tables of a page; what they hold stands beside each as JSON. Texts go into the page
// as texts alone.
(() => {
  const SVG = "http://www.w3.org/2000/svg";
  // Of a figure: errors of round-off size share the lowest place.
  const LOWEST = 1e-12;
  const MARKS = [
    "M-4 0a4 4 0 1 0 8 0a4 4 0 1 0-8 0z", "M-3.5-3.5h7v7h-7z", "M0-4.5l4.5 8h-9z", "M0-5l4 5l-4 5l-4-5z",
    "M0 4.5l4.5-8h-9z", "M-1.5-4.5h3v3h3v3h-3v3h-3v-3h-3v-3h3z", "M-4.5 0l8-4.5v9z", "M4.5 0l-8-4.5v9z",
  ];

  const KIND = ["part", "system", "data", "library", "method"];

  const fill = (one, attributes, children) => {
    for (const [name, value] of Object.entries(attributes)) one.setAttribute(name, value);
    one.append(...children);
    return one;
  };
  const make = (name, attributes = {}, ...children) => fill(document.createElement(name), attributes, children);
  const draw = (name, attributes = {}, ...children) => fill(document.createElementNS(SVG, name), attributes, children);
  const number = (text) => (text === "" ? NaN : Number(text.replace(/^(-?)inf$/, "$1Infinity")));
  const brief = (value) => (Number.isFinite(value) ? String(Number(value.toPrecision(3))) : "none");

  const dialog = make("dialog", { "aria-labelledby": "told" });
  document.body.append(dialog);
  const tell = (title, pairs) => {
    const list = make("dl");
    for (const [name, text] of pairs) list.append(make("dt", {}, name), make("dd", {}, text));
    const close = make("button", { type: "button", class: "plain", "aria-label": "Close" }, "\u00d7");
    close.addEventListener("click", () => dialog.close());
    dialog.replaceChildren(make("h2", { id: "told" }, title), close, list);
    dialog.showModal();
  };

  class Shown {
    constructor(box) {
      this.table = box.querySelector("table");
      this.data = JSON.parse(box.querySelector("script").textContent);
      this.body = this.table.tBodies[0];
      this.lines = [...this.body.rows];
      this.place = Object.fromEntries(this.data.columns.map(([name], k) => [name, k]));
      this.order = this.lines.map((_, k) => k);
      this.visible = this.order;
      this.tests = new Map();
      this.controls(box);
      this.heads();
      if (this.data.details.length) this.links();
      if (this.data.figure) this.figure = new Figure(this, box);
      this.choose();
    }

    controls(box) {
      const choose = make("div", { class: "choose" });
      for (const name of this.data.filters) choose.append(this.select(name));
      const search = make("input", { type: "search", size: 14 });
      search.addEventListener("input", () => {
        const words = search.value.toLowerCase().split(/\s+/).filter(Boolean);
        this.tests.set("search", (row) => {
          const text = row.join(" ").toLowerCase();
          return words.every((word) => text.includes(word));
        });
        this.choose();
      });
      const save = make("button", { type: "button", class: "plain" }, "Download these rows (CSV)");
      save.addEventListener("click", () => this.save());
      this.count = make("p", { class: "dim", role: "status" });
      choose.append(make("label", {}, "search", search), save);
      box.prepend(choose, this.count);
    }

    select(name) {
      const k = this.place[name], [, label, numeric] = this.data.columns[k];
      const values = [...new Set(this.data.rows.map((row) => row[k]))];
      if (numeric) values.sort((a, b) => number(a) - number(b));
      const chosen = make("select", { "data-column": name }, make("option", { value: "" }, "all"));
      // The first value stands for "all", so those of the data are told by their places.
      values.forEach((value, place) => chosen.append(make("option", { value: place + 1 }, value || "(empty)")));
      chosen.addEventListener("change", () => {
        const wanted = values[chosen.value - 1];
        this.tests.set(name, chosen.value ? (row) => row[k] === wanted : () => true);
        this.choose();
      });
      return make("label", {}, label, chosen);
    }

    heads() {
      [...this.table.tHead.rows[0].cells].forEach((head, k) => {
        const button = make("button", { type: "button" }, head.textContent);
        button.addEventListener("click", () => this.sort(k, head));
        head.replaceChildren(button);
      });
    }

    sort(k, head) {
      const down = head.getAttribute("aria-sort") === "ascending";
      for (const one of this.table.tHead.rows[0].cells) one.removeAttribute("aria-sort");
      head.setAttribute("aria-sort", down ? "descending" : "ascending");
      const numeric = this.data.columns[k][2], sign = down ? -1 : 1;
      const empty = (cell) => (numeric ? Number.isNaN(number(cell)) : cell === "");
      // Infinity less infinity is no number.
      const less = (a, b) => (numeric ? number(a) - number(b) || 0 : a.localeCompare(b, "en", { numeric: true }));
      // What is not known comes last either way.
      this.order.sort((one, other) => {
        const a = this.data.rows[one][k], b = this.data.rows[other][k];
        return empty(a) - empty(b) || (empty(a) ? 0 : sign * less(a, b)) || one - other;
      });
      this.body.append(...this.order.map((line) => this.lines[line]));
    }

    choose() {
      const tests = [...this.tests.values()];
      const kept = this.data.rows.map((row) => tests.every((test) => test(row)));
      this.lines.forEach((line, k) => { line.hidden = !kept[k]; });
      this.visible = kept.flatMap((one, k) => (one ? [k] : []));
      this.count.textContent = `${this.visible.length} of ${kept.length} rows`;
      this.figure?.redraw();
    }

    links() {
      this.lines.forEach((line, k) => line.querySelector("a.how").addEventListener("click", (event) => {
        event.preventDefault();
        this.explain(k);
      }));
    }

    explain(k) {
      const row = this.data.rows[k];
      const scores = this.data.columns.map(([, label], j) => [label, row[j]]).filter(([, text]) => text !== "");
      // Settings and seeds of the whole suite are many; those of the row are among its details.
      const about = this.data.about.filter(([name]) => name !== "settings" && name !== "seeds");
      tell(`How ${row[this.place.method]} came to E2 = ${brief(number(row[this.place.e2]))}`,
        [...this.data.details[k], ...about, ...scores]);
    }

    save() {
      // A cell that a spreadsheet would compute begins with an apostrophe.
      const plain = /^[+-]?(inf|nan|(\d+\.?\d*|\.\d+)(e[+-]?\d+)?)$/i;
      const safe = (cell) => (/^[=+\-@']/.test(cell) && !plain.test(cell) ? `'${cell}` : cell);
      const quoted = (cell) => (/[",\r\n]/.test(cell) ? `"${cell.replaceAll('"', '""')}"` : cell);
      const shown = new Set(this.visible);
      const rows = [this.data.columns.map(([name]) => name)];
      for (const k of this.order) if (shown.has(k)) rows.push(this.data.rows[k]);
      const about = this.data.about.map(([name, text]) => `# ${name}: ${text}\n`).join("");
      const text = about + rows.map((row) => row.map((cell) => quoted(safe(cell))).join(",") + "\n").join("");
      const href = URL.createObjectURL(new Blob([text], { type: "text/csv" }));
      make("a", { href, download: `${this.table.id}.csv` }).click();
      URL.revokeObjectURL(href);
    }
  }

  class Figure {
    constructor(shown, box) {
      this.shown = shown;
      this.about = shown.data.figure;
      this.methods = this.about.methods.map(([name]) => name);
      this.x = this.pick("horizontal axis", this.about.x, this.about.first);
      this.y = this.pick("vertical axis", this.about.y.map(([name]) => name), this.about.y[0][0]);
      const label = "Figure; arrow keys go from point to point, Enter tells how one was made";
      this.svg = draw("svg", { tabindex: 0, role: "group", "aria-label": label });
      this.told = make("output", {}, "");
      const controls = make("div", { class: "choose" }, this.x.label, this.y.label);
      const place = box.querySelector(".wide");
      place.before(this.legend(), controls, make("div", { class: "drawn" }, this.svg), this.told);
      this.svg.addEventListener("keydown", (event) => this.key(event));
      this.svg.addEventListener("pointermove", (event) => this.go(this.nearest(event)));
      this.svg.addEventListener("click", (event) => {
        this.go(this.nearest(event));
        if (this.points.length) shown.explain(this.points[this.at].row);
      });
      let width = 0;
      new ResizeObserver(() => {
        if (this.svg.clientWidth !== width) { width = this.svg.clientWidth; this.redraw(); }
      }).observe(this.svg);
    }

    pick(name, values, first) {
      const { columns } = this.shown.data;
      const select = make("select", { "data-axis": name });
      for (const value of values) {
        const option = make("option", { value }, columns[this.shown.place[value]][1]);
        option.selected = value === first;
        select.append(option);
      }
      select.addEventListener("change", () => this.redraw());
      return { select, label: make("label", {}, name, select) };
    }

    mark(method, x, y, extra = {}) {
      const k = this.methods.indexOf(method), transform = `translate(${x} ${y})`;
      return draw("path", { d: MARKS[k % MARKS.length], fill: this.about.methods[k][1], transform, ...extra });
    }

    legend() {
      const chosen = new Set(this.methods), column = this.shown.place.method;
      const box = make("div", { class: "methods" });
      for (const method of this.methods) {
        const tick = make("input", { type: "checkbox", "data-method": method });
        tick.checked = true;
        tick.addEventListener("change", () => {
          if (tick.checked) chosen.add(method); else chosen.delete(method);
          this.shown.tests.set("method", (row) => chosen.has(row[column]));
          this.shown.choose();
        });
        const swatch = draw("svg", { width: 16, height: 16, "aria-hidden": "true" }, this.mark(method, 8, 8));
        box.append(make("label", {}, tick, swatch, method));
      }
      return make("fieldset", {}, make("legend", {}, "methods"), box);
    }

    redraw() {
      const width = this.svg.clientWidth, height = Math.round(Math.min(460, Math.max(300, width * 0.55)));
      if (!width) return;
      const [across, up] = [this.x.select.value, this.y.select.value];
      const { rows, columns } = this.shown.data, { place } = this.shown;
      const log = this.about.y.find(([name]) => name === up)[1];
      this.points = this.shown.visible.flatMap((row) => {
        const cells = rows[row], x = number(cells[place[across]]), y = number(cells[place[up]]);
        const kind = JSON.stringify(KIND.map((name) => cells[place[name]]));
        return Number.isFinite(x) && !Number.isNaN(y) ? [{ row, x, y, kind, method: cells[place.method] }] : [];
      });
      const frame = { left: 58, right: width - 14, top: 12, bottom: height - 44 };
      const held = (y) => (log ? Math.max(y, LOWEST) : y);
      const xs = this.points.map((p) => p.x), ys = this.points.map((p) => held(p.y)).filter(Number.isFinite);
      const sx = scale(xs, true, frame.left, frame.right, xs.includes(0), across === "noise");
      const sy = scale(ys, log, frame.bottom, frame.top, false);
      this.svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
      this.svg.setAttribute("height", height);
      const parts = [...axes(sx, sy, frame, columns[place[across]][1], columns[place[up]][1])];
      // At one level of noise the methods stand side by side.
      const apart = across === "noise" ? 3 : 0, middle = (this.methods.length - 1) / 2;
      const offset = (method) => (this.methods.indexOf(method) - middle) * apart;
      for (const p of this.points) {
        p.left = sx.at(p.x) + offset(p.method);
        p.top = Number.isFinite(p.y) ? sy.at(held(p.y)) : frame.top;
      }
      if (across === "noise") parts.push(...this.medians(sx, sy, held, up, frame));
      const faint = this.points.length > 60 && across === "noise" ? 0.3 : 0.9;
      for (const p of this.points) {
        if (up === "e2" && this.points.length <= 150) parts.push(...this.spread(p, sy, held, frame.top));
        parts.push(this.mark(p.method, p.left, p.top, { opacity: faint, class: "point" }));
      }
      this.points.sort((a, b) => a.left - b.left || a.top - b.top);
      const ring = { r: 8, fill: "none", stroke: this.about.ink, "stroke-width": 2, visibility: "hidden" };
      this.ring = draw("circle", ring);
      this.svg.replaceChildren(...parts, this.ring);
      this.at = 0;
      this.told.textContent = this.points.length ? this.caption(across) : "No row that is chosen has such a point.";
    }

    caption(across) {
      const lines = "Lines are medians over those of the chosen rows whose data have several levels of noise. ";
      const rims = `A point at the upper rim has no result, and errors below ${LOWEST} share the lowest place. `;
      return `${across === "noise" ? lines : ""}${rims}Choose a point to see how it was made.`;
    }

    medians(sx, sy, held, up, frame) {
      const { rows } = this.shown.data, { place } = this.shown, parts = [], levels = {};
      for (const p of this.points) (levels[p.kind] ??= new Set()).add(p.x);
      const several = this.points.filter((p) => levels[p.kind].size > 1);
      const line = (points, colour, extra) => {
        const xs = [...new Set(points.map((p) => p.x))].sort((a, b) => a - b);
        const path = xs.map((level, k) => {
          const sorted = points.filter((p) => p.x === level).map((p) => p.y).sort((a, b) => a - b);
          const middle = sorted.length / 2, y = (sorted[Math.ceil(middle) - 1] + sorted[Math.floor(middle)]) / 2;
          return `${k ? "L" : "M"}${sx.at(level) + points[0].shift} ${Number.isFinite(y) ? sy.at(held(y)) : frame.top}`;
        });
        const drawn = { d: path.join(""), stroke: colour, fill: "none", "stroke-width": 2, ...extra };
        if (xs.length > 1) parts.push(draw("path", drawn));
      };
      this.about.methods.forEach(([method, colour, again]) => {
        const points = several.filter((p) => p.method === method);
        const dots = again ? { "stroke-dasharray": "2 3" } : {};
        line(points.map((p) => ({ ...p, shift: p.left - sx.at(p.x) })), colour, dots);
      });
      if (up === "e2" && "bound" in place) {
        const bounds = several.map((p) => ({ x: p.x, y: number(rows[p.row][place.bound]), shift: 0 }));
        line(bounds.filter((p) => p.y > 0), this.about.ink, { "stroke-dasharray": "6 4", class: "bound" });
        const corner = { x: frame.right, y: frame.bottom - 6, "text-anchor": "end" };
        if (bounds.some((p) => p.y > 0)) parts.push(draw("text", corner, "dashed: Cram\u00e9r-Rao bound, all terms kept"));
      }
      return parts;
    }

    spread(p, sy, held, rim) {
      const cells = this.shown.data.rows[p.row], { place } = this.shown;
      if (!("e2_low" in place) || cells[place.e2_low] === "") return [];
      const at = (y) => (Number.isFinite(y) ? sy.at(held(y)) : rim);
      const [low, high] = ["e2_low", "e2_high"].map((name) => at(number(cells[place[name]])));
      const stroke = this.about.methods[this.methods.indexOf(p.method)][1];
      return [draw("path", { d: `M${p.left} ${low}V${high}`, stroke, "stroke-width": 1.2, opacity: 0.6 })];
    }

    nearest(event) {
      const box = this.svg.getBoundingClientRect(), x = event.clientX - box.left, y = event.clientY - box.top;
      const far = (p) => (p.left - x) ** 2 + (p.top - y) ** 2;
      return this.points.reduce((best, p, k) => (far(p) < far(this.points[best]) ? k : best), 0);
    }

    key(event) {
      const step = { ArrowRight: 1, ArrowDown: 1, ArrowLeft: -1, ArrowUp: -1 }[event.key];
      if (!this.points.length || !(step || event.key === "Enter")) return;
      event.preventDefault();
      const first = this.ring.getAttribute("visibility") === "hidden";
      if (!step) this.shown.explain(this.points[this.at].row);
      else this.go(first ? 0 : Math.min(Math.max(this.at + step, 0), this.points.length - 1));
    }

    go(k) {
      if (!this.points.length) return;
      this.at = k;
      const p = this.points[k], cells = this.shown.data.rows[p.row], { place } = this.shown;
      fill(this.ring, { cx: p.left, cy: p.top, visibility: "visible" }, []);
      const told = ["part", "system", "data", "library"].map((name) => cells[place[name]]).filter(Boolean).join(" ");
      const pair = (name) => `${this.shown.data.columns[place[name]][1]} ${brief(number(cells[place[name]]))}`;
      const numbers = new Set(["noise", this.x.select.value, this.y.select.value]);
      this.told.textContent = `${p.method}: ${told}, ${[...numbers].map(pair).join(", ")}`;
    }
  }

  // An axis from a to b: a logarithmic one has a place of its own for 0.
  // With `own`, ticks are the values themselves.
  function scale(values, log, a, b, zero, own) {
    const used = log ? values.filter((value) => value > 0) : values;
    const start = zero ? a + Math.sign(b - a) * 44 : a, sign = Math.sign(b - start);
    if (!used.length) return { at: () => (zero ? a + 20 * sign : (a + b) / 2), ticks: zero ? [0] : [] };
    const form = log ? Math.log10 : (value) => value;
    let low = Math.min(...used.map(form)), high = Math.max(...used.map(form));
    if (log) { low = Math.floor(low + 1e-9); high = Math.max(Math.ceil(high - 1e-9), low + 1); }
    else { low = Math.min(low, 0); high = high > low ? high : low + 1; }
    const from = start + 12 * sign, to = b - 12 * sign;
    const share = (value) => (form(value) - low) / (high - low);
    const at = (value) => (log && value <= 0 ? a + 20 * sign : from + share(value) * (to - from));
    const step = Math.max(1, Math.ceil(((high - low) * 44) / Math.abs(to - from))), apart = 26;
    const far = (value, k, all) => !k || Math.abs(at(value) - at(all[k - 1])) > apart;
    const many = Math.floor((high - low) / step) + 1;
    const decades = () => Array.from({ length: many }, (_, k) => Number(`1e${low + k * step}`));
    const quarters = () => [0, 0.25, 0.5, 0.75, 1].map((part) => low + part * (high - low));
    const ticks = own ? [...new Set(used)].sort((c, d) => c - d).filter(far) : log ? decades() : quarters();
    return { at, ticks: zero ? [0, ...ticks] : ticks };
  }

  function* axes(sx, sy, frame, across, up) {
    const line = (d) => draw("path", { d, stroke: "#c9ced4", fill: "none" });
    const plain = (value) => value === 0 || (Math.abs(value) >= 1e-3 && Math.abs(value) < 1e5);
    const shown = (value) => (plain(value) ? brief(value) : value.toExponential(0));
    for (const value of sy.ticks) {
      yield line(`M${frame.left} ${sy.at(value)}H${frame.right}`);
      yield draw("text", { x: frame.left - 6, y: sy.at(value) + 4, "text-anchor": "end" }, shown(value));
    }
    for (const value of sx.ticks) {
      yield line(`M${sx.at(value)} ${frame.bottom}v5`);
      yield draw("text", { x: sx.at(value), y: frame.bottom + 19, "text-anchor": "middle" }, shown(value));
    }
    yield line(`M${frame.left} ${frame.top}V${frame.bottom}H${frame.right}`);
    yield draw("text", { x: (frame.left + frame.right) / 2, y: frame.bottom + 37, "text-anchor": "middle" }, across);
    const turned = `translate(13 ${(frame.top + frame.bottom) / 2}) rotate(-90)`;
    yield draw("text", { transform: turned, "text-anchor": "middle" }, up);
  }

  for (const box of document.querySelectorAll(".shown")) new Shown(box);
})();
