(() => {
  const report = JSON.parse(document.getElementById("data").textContent);
  const lpips = report.lpips_net ? `LPIPS (${report.lpips_net})` : "LPIPS";
  const unseen = report.unseen_lpips_net && `LPIPS (${report.unseen_lpips_net})`;
  // A field has a number of parameters instead of splats.
  const isField = known(report.parameters);
  document.title = `${report.dataset || "Report"} – Irradia`;
  at("version").textContent = report.version;
  at("title").textContent = report.dataset || "Report";
  at("subtitle").textContent = [report.recipe && `recipe ${report.recipe}`, report.device].filter(Boolean).join(" · ");
  for (const [label, value, unit] of [
    ["PSNR", fixed(report.psnr, 2), "dB"],
    ["Colour-corrected", fixed(report.psnr_corrected, 2), "dB"],
    ["SSIM", fixed(report.ssim, 4)],
    [lpips, fixed(report.lpips, 4)],
    ...(unseen ? [[unseen, fixed(report.unseen_lpips, 4)]] : []),
    isField ? ["Parameters", whole(report.parameters)] : ["Splats", whole(report.splats)],
    ["Steps", whole(report.steps)],
    ["First to last step", duration(report.seconds)],
    ["Peak memory", bytes(report.peak_rss_bytes)],
  ]) {
    const box = make("div");
    const figure = make("dd", value);
    if (unit) figure.append(make("small", unit));
    box.append(make("dt", label), figure);
    at("figures").append(box);
  }

  const notes = [...report.warnings];
  if (report.trained_on_lpips) {
    const other = unseen ? `; ${unseen} is not part of its loss` : "";
    notes.push(`this run was trained on LPIPS (${report.trained_on_lpips}), which flatters that figure${other}`);
  }
  if (report.corner_brightness) {
    const corners = `corners of the photographs have ${fixed(report.corner_brightness, 2)} of the middle's brightness`;
    notes.push(`${corners}: the scene does not contain this vignette; held-out views are shown and measured with it`);
  }
  if (notes.length) {
    at("warnings").hidden = false;
    for (const line of notes) at("warning-list").append(make("li", line));
  }

  // Held-out views: a selector, truth and render with a slider, the error beside them.
  let chosen = 0;
  const views = report.views;
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
  at("view").addEventListener("change", () => show(Number(at("view").value)));
  at("previous").addEventListener("click", () => show(chosen - 1));
  at("next").addEventListener("click", () => show(chosen + 1));

  // The table of metrics; a click on a heading sorts, a second click reverses the order.
  const columns = [
    ["View", (v) => v.name, (v) => v.name],
    ["PSNR, dB", (v) => v.psnr, (v) => fixed(v.psnr, 2)],
    ["corrected, dB", (v) => v.psnr_corrected, (v) => fixed(v.psnr_corrected, 2)],
    ["SSIM", (v) => v.ssim, (v) => fixed(v.ssim, 4)],
    [lpips, (v) => v.lpips, (v) => fixed(v.lpips, 4)],
    ...(unseen ? [[unseen, (v) => v.unseen_lpips, (v) => fixed(v.unseen_lpips, 4)]] : []),
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
    const means = [fixed(report.psnr, 2), fixed(report.psnr_corrected, 2), fixed(report.ssim, 4), fixed(report.lpips, 4)];
    if (unseen) means.push(fixed(report.unseen_lpips, 4));
    for (const text of means) mean.append(make("td", text));
    const [head, foot] = [make("thead"), make("tfoot")];
    head.append(heads);
    foot.append(mean);
    at("table").replaceChildren(head, body, foot);
  };
  if (views.length) {
    views.forEach((view, index) => at("view").append(make("option", view.name, { value: String(index) })));
    fill();
    show(0);
    slider(at("compare"));
  } else {
    at("views").hidden = true;
    at("metrics").hidden = true;
  }

  // Curves.
  const curves = (axis) => {
    const series = (key) =>
      report.curve.filter((p) => known(p[axis]) && known(p[key])).map((p) => ({ x: p[axis], y: p[key] }));
    at("curves").replaceChildren(
      chart("Loss", [{ color: "var(--loss)", points: series("loss") }], { smooth: true, zero: true, digits: 4 }),
      chart("PSNR", [{ color: "var(--psnr)", points: series("psnr") }], { digits: 2, unit: " dB" }),
      ...(isField ? [] : [chart("Splats", [{ color: "var(--count)", points: series("splats") }], { zero: true })]),
    );
    at("over-steps").setAttribute("aria-pressed", String(axis === "step"));
    at("over-seconds").setAttribute("aria-pressed", String(axis === "seconds"));
  };
  at("over-steps").addEventListener("click", () => curves("step"));
  at("over-seconds").addEventListener("click", () => curves("seconds"));
  curves("step");

  // The parameters over steps, one chart per kind; a kind that never changes is listed as text.
  const { schedule } = report;
  if (schedule && schedule.steps.length > 1) {
    at("schedule-part").hidden = false;
    const brief = (y) => (y !== 0 && Math.abs(y) < 1e-3 ? y.toExponential(1) : String(+y.toPrecision(3)));
    const marks = report.stages.slice(1).map((stage) => stage.first_step - 1);
    const still = [];
    for (const [kind, title, options] of [
      ["scale", "Image scale", { zero: true }],
      ["count", "Splats allowed and trained, fractions", { zero: true }],
      ["degree", "Degree of spherical harmonics", { zero: true }],
      ["rate", "Learning rates", { log: true }],
      ["loss", "Weights of losses", { zero: true }],
      ["noise", "Noise on the means, as a factor on their rate", { zero: true }],
      ["cap", "Largest condition number of a splat", { log: true }],
    ]) {
      const knobs = schedule.knobs.filter((knob) => knob.name.startsWith(`${kind}.`));
      const named = knobs.map(({ name, values }) => ({ name: name.slice(kind.length + 1), values }));
      const moving = named.filter(({ values }) => values.some((value) => value !== values[0]));
      if (!moving.length) {
        if (named.length) still.push(`${title}: ${named.map(({ name, values }) => `${name} ${brief(values[0])}`).join(", ")}`);
        continue;
      }
      const lines = named.map(({ name, values }, i) => ({ name, color: color(i),
        points: values.map((y, j) => ({ x: schedule.steps[j], y })).filter((p) => !options.log || p.y > 0) }));
      at("schedule").append(chart(title, lines, { ...options, marks, legend: lines.length > 1, tell: brief }));
    }
    const source = schedule.done ? "As executed, over steps" :
      "As planned, aligned with the steps of each stage: for a run with a time budget it is not known how early stages ended";
    const names = report.stages.map((stage) => stage.name).join(", ");
    at("schedule-note").textContent =
      `${source}; vertical lines separate the stages ${names}.${still.length ? ` Unchanged: ${still.join("; ")}.` : ""}`;
  }

  // Machine, stages, recipe.
  const machine = report.machine;
  const spent = (times) =>
    Object.entries(times || {}).filter(([, seconds]) => seconds >= 0.05).map(([what, seconds]) => `${what} ${duration(seconds)}`).join(", ");
  for (const [label, value] of [
    ["Processor", machine.cpu],
    ["Cores", whole(machine.cores)],
    ["Memory", bytes(machine.memory)],
    ["System", machine.os],
    ["Device", report.device],
    ["Steps only", `${duration(report.training_seconds)} (${duration(report.cpu_seconds)} of CPU time)`],
    ["First to last step", [duration(report.seconds), spent(report.breakdown?.inside)].filter(Boolean).join(": ")],
    ["Before and after", spent(report.breakdown?.beside)],
    ["Total", duration(report.total_seconds)],
    ["Per step", known(report.training_seconds) && report.steps ? `${((1e3 * report.training_seconds) / report.steps).toFixed(1)} ms` : "–"],
    ["Background", report.background],
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
