"use strict";
// The live page: what the events say, and orders by POST. Addresses are relative, so that any tunnel will do.
(() => {
  const get = (id) => document.getElementById(id);
  const key = decodeURIComponent(location.hash.slice(1));
  const MOST_ROWS = 600, STALE_MS = 1500;
  const MM = 1000, DEG = 180 / Math.PI;
  const CURVES = [[2, MM, "x", "mm", "--x"], [3, MM, "y", "mm", "--y"], [4, MM, "z", "mm", "--z"],
    [5, DEG, "yaw", "deg", "--z"], [6, DEG, "pitch", "deg", "--y"], [7, DEG, "roll", "deg", "--x"]];
  const turn = { yaw: 0.35, pitch: 0.35 };
  let setup = { sliders: [], exposure: null, axes: null, beacons: {} };
  let capture = null, rows = [], heard_ms = 0, is_over = false, is_due = false;

  const node = (name, properties = {}, ...children) => {
    const made = Object.assign(document.createElement(name), properties);
    made.append(...children);
    return made;
  };
  const fixed = (value, digits) => (value === null || value === undefined ? "–" : value.toFixed(digits));

  // Orders ------------------------------------------------------------------
  async function order(path, body = {}) {
    const said = get("said");
    try {
      const answer = await fetch(path, { method: "POST", headers: { "Content-Type": "application/json", "X-Uvgs-Key": key },
        body: JSON.stringify(body) });
      const told = await answer.json();
      said.textContent = told.said;
      said.className = told.is_done ? "done" : "";
      return told.is_done;
    } catch (error) {
      said.textContent = "uvgs run does not answer";
      said.className = "";
      return false;
    }
  }

  function slider(spec, words, to_value, from_value, shown, send) {
    const name = node("span", { textContent: words }), output = node("output");
    const input = node("input", { type: "range", min: 0, max: 1000, step: 1, disabled: !key });
    input.setAttribute("aria-label", words);
    const show = (value) => { output.textContent = shown(value); };
    input.value = from_value(spec.value);
    show(spec.value);
    input.addEventListener("input", () => show(to_value(Number(input.value))));
    input.addEventListener("change", () => send(to_value(Number(input.value))));
    return node("label", { className: "slider" }, name, output, input);
  }

  function linear(spec) {
    const span = spec.greatest - spec.least;
    const to = (place) => Number((spec.least + Math.round(place / 1000 * span / spec.step) * spec.step).toFixed(6));
    const digits = Math.max(0, Math.ceil(-Math.log10(spec.step)));
    return slider(spec, spec.name, to, (value) => Math.round((value - spec.least) / span * 1000),
      (value) => value.toFixed(digits), (value) => order("tune", { changes: { [spec.name]: value } }));
  }

  function logarithmic(spec) {
    const ratio = Math.log(spec.greatest / spec.least);
    const to = (place) => Math.min(Math.max(spec.least * Math.exp(place / 1000 * ratio), spec.least), spec.greatest);
    return slider(spec, "exposure", to, (value) => Math.round(Math.log(value / spec.least) / ratio * 1000),
      (value) => `${(value * MM).toPrecision(3)} ms`, (value) => order("expose", { exposure_s: value }));
  }

  function configure(told) {
    setup = told;
    const made = told.sliders.map(linear);
    if (told.exposure) made.unshift(logarithmic(told.exposure));
    if (!made.length) made.push(node("p", { className: "faint", textContent: "Nothing can be changed in this run." }));
    get("sliders").replaceChildren(...made);
    get("nokey").hidden = Boolean(key);
    get("save").hidden = !told.sliders.length;
    for (const button of document.querySelectorAll("[data-key]")) button.disabled = !key;
    for (const button of document.querySelectorAll("[data-motion]")) button.disabled = !key || !told.axes;
    if (!told.axes) {
      get("gantry-said").textContent = "May not be moved from here: start uvgs run with --allow-motion BENCH.";
    }
    get("axes").replaceChildren(...(told.axes || []).map((axis) => {
      const steps = [-10, -1, -0.1, 0.1, 1, 10];
      const factor = axis.unit === "m" ? MM : DEG;
      const buttons = steps.map((step) => {
        const button = node("button", { type: "button", textContent: `${step > 0 ? "+" : "−"}${Math.abs(step)}`, disabled: !key });
        button.addEventListener("click", () => order("jog", { axis: axis.name, offset: step / factor }));
        return button;
      });
      const where = node("b", { textContent: axis.name });
      where.dataset.axis = axis.name;
      return node("div", { className: "axis" }, where, ...buttons);
    }));
    draw();
  }

  // Drawing -----------------------------------------------------------------
  function show_pose(beacon) {
    const status = get("status");
    status.className = `chip ${beacon.status}`;
    status.textContent = { ok: "pose", held: "held", miss: "no pose" }[beacon.status];
    get("beacon").textContent = beacon.name;
    const words = [];
    if (beacon.status === "held") words.push(`an old pose, repeated for ${fixed(beacon.held_age_s, 2)} s`);
    if (beacon.reason) words.push(`${beacon.reason}: ${beacon.detail}`);
    if (beacon.flags.length) words.push(beacon.flags.join(", "));
    get("why").textContent = words.join(" · ");
    const pose = beacon.pose, angles = beacon.euler_zyx_rad;
    const at = (list, k, factor) => (list ? list[k] * factor : null);
    const lines = [
      ...["x", "y", "z"].map((name, k) => [name, fixed(at(pose && pose.t_m, k, MM), 3), fixed(at(beacon.position_sigma_m, k, MM), 3), "mm"]),
      ...["yaw", "pitch", "roll"].map((name, k) => [name, fixed(at(angles, k, DEG), 4), "", "deg"]),
      ...["x", "y", "z"].map((name, k) => [`about camera ${name}`, "", fixed(at(beacon.rotation_sigma_rad, k, DEG), 4), "deg"]),
    ].filter((line) => !(line[0].startsWith("about") && !beacon.rotation_sigma_rad));
    get("figures").replaceChildren(...lines.map((line) => node("tr", {}, node("th", { textContent: line[0] }),
      node("td", { className: "num", textContent: line[1] }), node("td", { className: "num", textContent: line[2] }),
      node("td", { className: "faint", textContent: line[3] }))));
  }

  function show_facts(beacon) {
    const ms = (value) => (value === null ? "–" : `${(value * MM).toFixed(1)} ms`);
    const margin = beacon.status !== "ok" ? "–" : beacon.margin === null ? "no runner-up" : beacon.margin.toPrecision(3);
    const facts = [["residual", beacon.rms_px === null ? "–" : `${beacon.rms_px.toFixed(3)} px`], ["margin", margin],
      ["blobs", String(beacon.blob_count)], ["rate", `${capture.rate_hz.toFixed(1)} Hz`], ["latency", ms(capture.latency_s)],
      ["solved in", ms(capture.work_s)], ["exposure", capture.exposure_s === null ? "–" : ms(capture.exposure_s)],
      ["captures", capture.total === null ? String(capture.number) : `${capture.number} of ${capture.total}`],
      ["with a pose", String(capture.poses)], ["dropped", String(capture.dropped)]];
    get("facts").replaceChildren(...facts.map(([name, value]) => node("div", {}, node("dt", { textContent: name }),
      node("dd", { textContent: value }))));
  }

  function show_zooms() {
    get("zooms").replaceChildren(...capture.zooms.map((zoomed) => {
      const canvas = node("canvas");
      Drawing.zoom(canvas, zoomed);
      const peak = ` ${zoomed.peak_dn.toFixed(0)} of ${zoomed.full_scale_dn.toFixed(0)} DN`;
      const clip = zoomed.clipped ? [node("span", { className: "clip", textContent: `, ${zoomed.clipped} px clipped` })] : [];
      return node("figure", {}, canvas, node("figcaption", {}, node("b", { textContent: zoomed.name }), peak, ...clip));
    }));
  }

  function show_gantry(gantry) {
    if (!gantry) return;
    get("activity").textContent = gantry.activity;
    get("activity").className = `chip ${gantry.is_homed ? "ok" : "held"}`;
    get("gantry-said").textContent = gantry.is_homed ? gantry.said : `Not homed: positions mean nothing. ${gantry.said}`;
    for (const [name, words] of gantry.positions) {
      for (const where of document.querySelectorAll("[data-axis]")) {
        if (where.dataset.axis === name) where.textContent = `${name}  ${words}`;
      }
    }
  }

  function draw() {
    is_due = false;
    if (!capture) return;
    get("picture").style.aspectRatio = `${capture.width_px} / ${capture.height_px}`;
    if (get("overlay").checked) Drawing.marks(get("marks"), capture, setup.beacons); else get("marks").replaceChildren();
    const active = capture.beacons.find((beacon) => beacon.is_active) || capture.beacons[0];
    if (active) {
      show_pose(active);
      show_facts(active);
      const others = capture.beacons.filter((beacon) => beacon !== active);
      get("others").textContent = others.map((beacon) => `${beacon.name}: ${beacon.reason || "pose, not active"}`).join(" · ");
    }
    get("source").textContent = `${capture.source} · capture ${capture.index}`;
    show_zooms();
    show_gantry(capture.gantry);
    Drawing.space(get("space"), capture, setup.beacons, turn);
    CURVES.forEach(([column, factor, title, unit, name], k) =>
      Drawing.curve(get("curves").children[k], rows, column, factor, title, unit, name));
    document.body.dataset.drawn = String(Number(document.body.dataset.drawn || 0) + 1);
  }

  function ask_draw() {
    if (is_due) return;
    is_due = true;
    requestAnimationFrame(draw);
  }

  function look_at_age() {
    const age_ms = performance.now() - heard_ms, is_stale = Boolean(capture) && age_ms > STALE_MS;
    get("picture").classList.toggle("stale", is_stale);
    const link = get("link");
    link.className = `chip ${is_over ? "none" : is_stale ? "miss" : capture ? "ok" : "none"}`;
    link.textContent = is_over ? "ended" : is_stale ? `nothing new for ${(age_ms / 1000).toFixed(0)} s` : capture ? "live" : "connecting";
  }

  // Events ------------------------------------------------------------------
  function listen() {
    const events = new EventSource("events");
    events.addEventListener("setup", (event) => configure(JSON.parse(event.data)));
    events.addEventListener("capture", (event) => {
      capture = JSON.parse(event.data);
      heard_ms = performance.now();
      const last = rows.length ? rows[rows.length - 1][0] : 0;
      // A lower number is another run behind the same address.
      if (capture.number < last) rows = [];
      const newest = rows.length ? rows[rows.length - 1][0] : 0;
      rows = rows.concat(capture.past.filter((row) => row[0] > newest)).slice(-MOST_ROWS);
      ask_draw();
    });
    events.addEventListener("over", () => { is_over = true; events.close(); look_at_age(); });
  }

  get("curves").append(...CURVES.map(() => node("canvas")));
  get("brighten").addEventListener("change", (event) => get("stream").classList.toggle("bright", event.target.checked));
  get("overlay").addEventListener("change", draw);
  get("snapshot").addEventListener("click", () => order("snapshot"));
  get("save").addEventListener("click", () => order("save"));
  get("home").addEventListener("click", () => order("home"));
  get("stop").addEventListener("click", () => order("stop"));
  get("space").addEventListener("pointermove", (event) => {
    if (!event.buttons) return;
    turn.yaw += event.movementX / 150;
    turn.pitch = Math.min(1.5, Math.max(-1.5, turn.pitch + event.movementY / 150));
    ask_draw();
  });
  window.addEventListener("resize", ask_draw);
  window.addEventListener("hashchange", () => location.reload());
  setInterval(look_at_age, 250);
  listen();
  // After the page has loaded: a stream of pictures never ends, and would keep the page loading.
  window.addEventListener("load", () => { get("stream").src = "stream.mjpg"; });
})();
