"use strict";
(() => {
  const report = JSON.parse(document.getElementById("data").textContent);
  const at = (id) => document.getElementById(id);
  const make = (name, text, attributes = {}) => {
    const element = document.createElement(name);
    if (text !== undefined) element.textContent = text;
    for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
    return element;
  };

  // A number that was not finite arrives as null and is shown as a dash.
  const known = (x) => typeof x === "number" && Number.isFinite(x);
  const fixed = (x, digits) => (known(x) ? x.toFixed(digits) : "–");
  const whole = (x) => (known(x) ? Math.round(x).toLocaleString("en") : "–");
  const duration = (s) => {
    if (!known(s)) return "–";
    if (s < 60) return `${s.toFixed(1)} s`;
    const [minutes, rest] = [Math.floor(Math.round(s) / 60), Math.round(s) % 60];
    return minutes < 60 ? `${minutes} min ${rest} s` : `${Math.floor(minutes / 60)} h ${minutes % 60} min`;
  };
  const bytes = (b) => (!b ? "–" : b < 1e9 ? `${Math.round(b / 1e6)} MB` : `${(b / 1e9).toFixed(1)} GB`);

  document.title = `${report.dataset || "Report"} – Irradia`;
  at("version").textContent = report.version;
  at("title").textContent = report.dataset || "Report";
  at("subtitle").textContent = [report.recipe && `recipe ${report.recipe}`, report.device].filter(Boolean).join(" · ");
  for (const [label, value, unit] of [
    ["PSNR", fixed(report.psnr, 2), "dB"],
    ["SSIM", fixed(report.ssim, 4)],
    ["LPIPS", fixed(report.lpips, 4)],
    ["Splats", whole(report.splats)],
    ["Steps", whole(report.steps)],
    ["Training", duration(report.seconds)],
    ["Peak memory", bytes(report.peak_rss_bytes)],
  ]) {
    const box = make("div");
    const figure = make("dd", value);
    if (unit) figure.append(make("small", unit));
    box.append(make("dt", label), figure);
    at("figures").append(box);
  }

  if (report.warnings.length) {
    at("warnings").hidden = false;
    for (const line of report.warnings) at("warning-list").append(make("li", line));
  }

  // Held-out views: a selector, truth and render with a divider, the error beside them.
  let chosen = 0;
  const views = report.views;
  const address = (path) => path.split("/").map(encodeURIComponent).join("/");
  const show = (index) => {
    chosen = (index + views.length) % views.length;
    const view = views[chosen];
    for (const kind of ["truth", "render", "error"]) {
      if (view[kind]) at(kind).src = address(view[kind]);
      else at(kind).removeAttribute("src");
    }
    at("view").value = String(chosen);
    at("view-figures").textContent =
      `Difference. PSNR ${fixed(view.psnr, 2)} dB · SSIM ${fixed(view.ssim, 4)} · LPIPS ${fixed(view.lpips, 4)}`;
    for (const row of at("table").querySelectorAll("tbody tr")) row.classList.toggle("chosen", row.dataset.view === String(chosen));
  };
  const compare = at("compare");
  let divide = 50;
  const slide = (percent) => {
    divide = Math.min(100, Math.max(0, percent));
    compare.style.setProperty("--at", `${divide}%`);
    compare.setAttribute("aria-valuenow", String(Math.round(divide)));
    compare.setAttribute("aria-valuetext", `${Math.round(divide)} percent photograph`);
  };
  const follow = (event) => {
    const box = compare.getBoundingClientRect();
    slide((100 * (event.clientX - box.left)) / box.width);
  };
  compare.addEventListener("pointerdown", (event) => {
    compare.setPointerCapture(event.pointerId);
    follow(event);
  });
  compare.addEventListener("pointermove", (event) => {
    if (compare.hasPointerCapture(event.pointerId)) follow(event);
  });
  compare.addEventListener("keydown", (event) => {
    const step = event.shiftKey ? 10 : 2;
    const to = { ArrowLeft: divide - step, ArrowDown: divide - step, ArrowRight: divide + step, ArrowUp: divide + step,
      PageDown: divide - 10, PageUp: divide + 10, Home: 0, End: 100 }[event.key];
    if (to === undefined) return;
    event.preventDefault();
    slide(to);
  });
  at("view").addEventListener("change", () => show(Number(at("view").value)));
  at("previous").addEventListener("click", () => show(chosen - 1));
  at("next").addEventListener("click", () => show(chosen + 1));

  // The table of metrics; a click on a heading sorts, a second one turns the order.
  const columns = [
    ["View", (v) => v.name, (v) => v.name],
    ["PSNR, dB", (v) => v.psnr, (v) => fixed(v.psnr, 2)],
    ["SSIM", (v) => v.ssim, (v) => fixed(v.ssim, 4)],
    ["LPIPS", (v) => v.lpips, (v) => fixed(v.lpips, 4)],
  ];
  let sorted = { column: 0, up: true };
  const before = (a, b) => {
    if (typeof a === "string") return a.localeCompare(b, "en", { numeric: true });
    if (!known(a) || !known(b)) return Number(known(b)) - Number(known(a));
    return a - b;
  };
  const fill = () => {
    const [, value] = columns[sorted.column];
    const order = views.map((_, index) => index);
    order.sort((a, b) => (sorted.up ? 1 : -1) * before(value(views[a]), value(views[b])) || a - b);
    const body = make("tbody");
    for (const index of order) {
      const row = make("tr", undefined, { "data-view": String(index) });
      columns.forEach(([, , text], number) => {
        const cell = make("td");
        if (number === 0) {
          const button = make("button", text(views[index]), { type: "button", title: "Show this view" });
          button.addEventListener("click", () => {
            show(index);
            at("views").scrollIntoView({ block: "start" });
          });
          cell.append(button);
        } else cell.textContent = text(views[index]);
        row.append(cell);
      });
      row.classList.toggle("chosen", index === chosen);
      body.append(row);
    }
    const heads = make("tr");
    columns.forEach(([name], column) => {
      const head = make("th", undefined, { scope: "col" });
      if (column === sorted.column) head.setAttribute("aria-sort", sorted.up ? "ascending" : "descending");
      const button = make("button", name, { type: "button" });
      button.addEventListener("click", () => {
        sorted = { column, up: column === sorted.column ? !sorted.up : true };
        fill();
        at("table").querySelectorAll("thead button")[column].focus();
      });
      head.append(button);
      heads.append(head);
    });
    const mean = make("tr");
    mean.append(make("td", "Mean"));
    for (const text of [fixed(report.psnr, 2), fixed(report.ssim, 4), fixed(report.lpips, 4)]) mean.append(make("td", text));
    const [head, foot] = [make("thead"), make("tfoot")];
    head.append(heads);
    foot.append(mean);
    at("table").replaceChildren(head, body, foot);
  };
  if (views.length) {
    views.forEach((view, index) => at("view").append(make("option", view.name, { value: String(index) })));
    fill();
    show(0);
    slide(50);
  } else {
    at("views").hidden = true;
    at("metrics").hidden = true;
  }

  // Curves. Each is drawn in a box of W x H units that scales with the page.
  const W = 340, H = 190, LEFT = 46, RIGHT = 8, TOP = 8, BOTTOM = 22;
  const svg = (name, attributes, text) => {
    const element = document.createElementNS("http://www.w3.org/2000/svg", name);
    for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
    if (text !== undefined) element.textContent = text;
    return element;
  };
  const short = (x) => {
    const size = Math.abs(x);
    if (size >= 1e6) return `${+(x / 1e6).toFixed(1)}M`;
    if (size >= 1e4) return `${+(x / 1e3).toFixed(1)}k`;
    return String(+x.toPrecision(3));
  };
  // Round numbers that part low..high into about four.
  const ticks = (low, high) => {
    const rough = (high - low) / 4, power = 10 ** Math.floor(Math.log10(rough));
    const step = [1, 2, 5, 10].map((m) => m * power).find((s) => s >= rough);
    const list = [];
    for (let number = Math.ceil(low / step - 1e-9); number * step <= high + step * 1e-9; number++) list.push(number * step);
    return list;
  };
  const draw = (title, color, points, { smooth = false, zero = false, digits = 0, unit = "" }) => {
    const box = make("div", undefined, { class: "curve" });
    const head = make("h3", title);
    const output = make("output", points.length ? `${fixed(points[points.length - 1].y, digits)}${unit}` : "–");
    head.append(output);
    box.append(head);
    const picture = svg("svg", { viewBox: `0 0 ${W} ${H}`, role: "img", "aria-label": `${title} over the run` });
    box.append(picture);
    if (points.length < 2) {
      picture.append(svg("text", { x: W / 2, y: H / 2, "text-anchor": "middle" }, "not measured during the run"));
      return box;
    }
    const [xs, ys] = [points.map((p) => p.x), points.map((p) => p.y)];
    const span = (list) => [list.reduce((a, b) => Math.min(a, b)), list.reduce((a, b) => Math.max(a, b))];
    const [x0, x1] = span(xs);
    let [y0, y1] = span(ys);
    // One wild first value must not flatten the rest.
    if (smooth) y1 = Math.min(y1, [...ys].sort((a, b) => a - b)[Math.floor(0.99 * (ys.length - 1))] * 1.25);
    if (zero) y0 = 0;
    if (y1 <= y0) y1 = y0 + (Math.abs(y0) || 1);
    const px = (x) => LEFT + ((x - x0) / (x1 - x0 || 1)) * (W - LEFT - RIGHT);
    const py = (y) => H - BOTTOM - ((Math.min(y, y1) - y0) / (y1 - y0)) * (H - TOP - BOTTOM);
    for (const y of ticks(y0, y1)) {
      picture.append(svg("line", { x1: LEFT, x2: W - RIGHT, y1: py(y), y2: py(y), class: "grid" }));
      picture.append(svg("text", { x: LEFT - 6, y: py(y) + 4, "text-anchor": "end" }, short(y)));
    }
    const marks = x1 > x0 ? ticks(x0, x1) : [x0];
    marks.forEach((x) => {
      const anchor = px(x) > W - 24 ? "end" : "middle";
      picture.append(svg("text", { x: px(x), y: H - 6, "text-anchor": anchor }, short(x)));
    });
    const line = (list) => `M${list.map((p) => `${px(p.x).toFixed(1)} ${py(p.y).toFixed(1)}`).join("L")}`;
    if (smooth && points.length > 40) {
      picture.append(svg("path", { d: line(points), class: "raw", style: `stroke: var(${color})` }));
      const reach = Math.ceil(points.length / 40);
      const means = points.map((p, index) => {
        const part = points.slice(Math.max(0, index - reach), index + reach + 1);
        return { x: p.x, y: part.reduce((sum, q) => sum + q.y, 0) / part.length };
      });
      picture.append(svg("path", { d: line(means), style: `stroke: var(${color})` }));
    } else picture.append(svg("path", { d: line(points), style: `stroke: var(${color})` }));
    const cursor = svg("line", { y1: TOP, y2: H - BOTTOM, class: "cursor", visibility: "hidden" });
    picture.append(cursor);
    picture.addEventListener("pointermove", (event) => {
      const frame = picture.getBoundingClientRect();
      const x = ((event.clientX - frame.left) / frame.width) * W;
      const near = points.reduce((a, b) => (Math.abs(px(b.x) - x) < Math.abs(px(a.x) - x) ? b : a));
      cursor.setAttribute("x1", px(near.x));
      cursor.setAttribute("x2", px(near.x));
      cursor.setAttribute("visibility", "visible");
      output.textContent = `${fixed(near.y, digits)}${unit} at ${short(near.x)}`;
    });
    picture.addEventListener("pointerleave", () => {
      cursor.setAttribute("visibility", "hidden");
      output.textContent = `${fixed(points[points.length - 1].y, digits)}${unit}`;
    });
    return box;
  };
  const curves = (axis) => {
    const series = (key) =>
      report.curve.filter((p) => known(p[axis]) && known(p[key])).map((p) => ({ x: p[axis], y: p[key] }));
    at("curves").replaceChildren(
      draw("Loss", "--loss", series("loss"), { smooth: true, zero: true, digits: 4 }),
      draw("PSNR", "--psnr", series("psnr"), { digits: 2, unit: " dB" }),
      draw("Splats", "--count", series("splats"), { zero: true }),
    );
    at("over-steps").setAttribute("aria-pressed", String(axis === "step"));
    at("over-seconds").setAttribute("aria-pressed", String(axis === "seconds"));
  };
  at("over-steps").addEventListener("click", () => curves("step"));
  at("over-seconds").addEventListener("click", () => curves("seconds"));
  curves("step");

  // Machine, stages, recipe.
  const machine = report.machine;
  for (const [label, value] of [
    ["Processor", machine.cpu],
    ["Cores", whole(machine.cores)],
    ["Memory", bytes(machine.memory)],
    ["System", machine.os],
    ["Device", report.device],
    ["Training", `${duration(report.seconds)} (${duration(report.cpu_seconds)} of processor time)`],
    ["All included", duration(report.total_seconds)],
    ["Per step", known(report.seconds) && report.steps ? `${((1e3 * report.seconds) / report.steps).toFixed(1)} ms` : "–"],
    ["Seed", String(report.seed)],
    ["Version", report.version],
  ]) at("machine").append(make("dt", label), make("dd", value || "–"));
  if (report.stages.length) {
    at("stages-part").hidden = false;
    const row = (cells, kind) => {
      const line = make("tr");
      for (const cell of cells) line.append(make(kind, cell));
      return line;
    };
    const [head, body] = [make("thead"), make("tbody")];
    head.append(row(["Stage", "Steps", "Time"], "th"));
    for (const stage of report.stages) {
      body.append(row([stage.name, `${whole(stage.first_step)} – ${whole(stage.last_step)}`, duration(stage.seconds)], "td"));
    }
    at("stages").append(head, body);
  }
  at("recipe-name").textContent = [report.recipe, report.recipe_hash.slice(0, 12)].filter(Boolean).join(" · ");
  at("recipe").textContent = report.recipe_toml || "–";
})();
