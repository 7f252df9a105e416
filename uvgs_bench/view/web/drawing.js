"use strict";
// Drawings of the live page. All text reaches the page as text nodes; nothing here writes markup.
const Drawing = (() => {
  const SVG = "http://www.w3.org/2000/svg";
  const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  const item = (name, attributes, text) => {
    const made = document.createElementNS(SVG, name);
    for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
    if (text !== undefined) made.textContent = text;
    return made;
  };

  function sized(canvas) {
    const scale = window.devicePixelRatio || 1;
    const width = Math.max(canvas.clientWidth, 10), height = Math.max(canvas.clientHeight, 10);
    if (canvas.width !== Math.round(width * scale) || canvas.height !== Math.round(height * scale)) {
      canvas.width = Math.round(width * scale);
      canvas.height = Math.round(height * scale);
    }
    const pen = canvas.getContext("2d");
    pen.setTransform(scale, 0, 0, scale, 0, 0);
    pen.clearRect(0, 0, width, height);
    return { pen, width, height };
  }

  function marks(svg, capture, leds) {
    const { width_px: w, height_px: h } = capture;
    // Whole numbers are centres of pixels.
    svg.setAttribute("viewBox", `-0.5 -0.5 ${w} ${h}`);
    svg.setAttribute("preserveAspectRatio", "none");
    const unit = w / Math.max(svg.clientWidth, 1), size = 13 * unit, drawn = [];
    const put = (...made) => drawn.push(item(...made));
    const line = (kind, a, b) => put("line", { class: kind, x1: a[0], y1: a[1], x2: b[0], y2: b[1] });
    const label = (px, text, kind = "", dx = 8, dy = -8) => put("text", {
      x: Math.min(Math.max(px[0] + dx * unit, 0), w - 4 * size), y: Math.min(Math.max(px[1] + dy * unit, size), h - 2 * unit),
      "font-size": size, class: kind }, text);
    const seen = capture.beacons.flatMap((beacon) => (beacon.led_px || []).filter(Boolean));
    for (const blob of capture.blobs) {
      const [x0, y0, x1, y1] = blob.box_px, margin = 3 + 2 * unit;
      const kind = blob.dropped ? "dropped" : "led";
      put("rect", { class: kind, x: x0 - margin, y: y0 - margin, width: x1 - x0 + 2 * margin, height: y1 - y0 + 2 * margin });
      const near = seen.some((px) => Math.hypot(px[0] - blob.centroid_px[0], px[1] - blob.centroid_px[1]) < 1.5);
      if (!near) label([x1, y1], `#${blob.index} ${blob.dropped}`.trim(), kind, 5, 12);
    }
    for (const beacon of capture.beacons) {
      const found = beacon.marks, names = (leds[beacon.name] || {}).leds || [];
      if (found) {
        const other = (found.runner_up_px || []).filter(Boolean);
        if (other.length) {
          const middle = [0, 1].map((k) => other.reduce((sum, px) => sum + px[k], 0) / other.length);
          for (const px of other) { line("other", middle, px); put("circle", { class: "other", cx: px[0], cy: px[1], r: 6 * unit }); }
        }
        if (beacon.status === "ok") {
          for (const px of found.projected_px.filter(Boolean)) put("circle", { class: "should", cx: px[0], cy: px[1], r: 2.5 * unit });
        }
        found.axes_px.slice(1).forEach((end, k) => {
          const origin = found.axes_px[0];
          if (end && origin) { line("xyz"[k], origin, end); label(end, "xyz"[k], "", 4, 4); }
        });
      }
      (beacon.led_px || []).forEach((px, k) => { if (px) label(px, names[k] || String(k)); });
    }
    svg.replaceChildren(...drawn);
  }

  function zoom(canvas, zoomed) {
    const side = zoomed.side_px;
    canvas.width = canvas.height = side;
    const pen = canvas.getContext("2d"), image = pen.createImageData(side, side), grey = atob(zoomed.grey);
    for (let i = 0; i < side * side; i += 1) {
      const value = grey.charCodeAt(i), is_clipped = value === 255;
      image.data.set(is_clipped ? [255, 40, 40, 255] : [value, value, value, 255], 4 * i);
    }
    pen.putImageData(image, 0, 0);
  }

  function curve(canvas, rows, column, factor, title, unit, name) {
    const { pen, width, height } = sized(canvas), left = 58, bottom = 16, top = 18;
    const ink = colour("--ink"), faint = colour("--faint"), rule = colour("--rule");
    pen.font = "12px system-ui, sans-serif";
    pen.fillStyle = ink;
    pen.fillText(title, left, 12);
    const points = rows.map((row) => [row[1], row[column] === null ? null : row[column] * factor]);
    const values = points.map((point) => point[1]).filter((value) => value !== null);
    if (!values.length) { pen.fillStyle = faint; pen.fillText("no pose yet", left, height / 2); return; }
    let low = Math.min(...values), high = Math.max(...values);
    const least = unit === "mm" ? 0.2 : 0.02;
    if (high - low < least) { const middle = (low + high) / 2; low = middle - least / 2; high = middle + least / 2; }
    const first = points[0][0], last = points[points.length - 1][0], span = Math.max(last - first, 1e-3);
    const x = (t) => left + (width - left - 6) * (t - first) / span;
    const y = (v) => top + (height - top - bottom) * (1 - (v - low) / (high - low));
    pen.strokeStyle = rule;
    pen.fillStyle = faint;
    pen.textAlign = "right";
    for (const value of [low, (low + high) / 2, high]) {
      pen.beginPath(); pen.moveTo(left, y(value)); pen.lineTo(width - 6, y(value)); pen.stroke();
      pen.fillText(value.toFixed(high - low < 1 ? 3 : high - low < 20 ? 2 : 1), left - 4, y(value) + 4);
    }
    pen.fillText(`${span.toFixed(1)} s`, width - 6, height - 3);
    pen.textAlign = "left";
    pen.fillText(unit, left, height - 3);
    pen.strokeStyle = pen.fillStyle = colour(name);
    pen.lineWidth = 1.6;
    pen.beginPath();
    let is_down = false;
    points.forEach(([t, v], k) => {
      if (v === null) { is_down = false; return; }
      if (is_down) pen.lineTo(x(t), y(v)); else pen.moveTo(x(t), y(v));
      const alone = !is_down && (k + 1 === points.length || points[k + 1][1] === null);
      if (alone) pen.rect(x(t) - 1, y(v) - 1, 2, 2);
      is_down = true;
    });
    pen.stroke();
    pen.lineWidth = 1;
  }

  function space(canvas, capture, leds, turn) {
    const { pen, width, height } = sized(canvas);
    const beacons = capture.beacons.filter((beacon) => beacon.pose);
    const reach = Math.max(0.3, ...beacons.map((beacon) => Math.hypot(...beacon.pose.t_m))) * 1.15;
    const [sin_a, cos_a, sin_b, cos_b] = [Math.sin(turn.yaw), Math.cos(turn.yaw), Math.sin(turn.pitch), Math.cos(turn.pitch)];
    const scale = 0.92 * Math.min(height, width / 1.35) / reach;
    // Seen from beside the camera: its z axis goes to the right, its y axis down.
    const at = ([x, y, z]) => {
      const depth = z - reach / 2, right = depth * cos_a - x * sin_a, away = depth * sin_a + x * cos_a;
      return [width / 2 + scale * right, height / 2 + scale * (y * cos_b - away * sin_b)];
    };
    const stroke = (points, style, wide = 1) => {
      pen.strokeStyle = style; pen.lineWidth = wide;
      pen.beginPath();
      points.forEach((point, k) => (k ? pen.lineTo(...at(point)) : pen.moveTo(...at(point))));
      pen.stroke();
    };
    const half = [0.35 * reach, 0.35 * reach * capture.height_px / capture.width_px];
    const corners = [[-1, -1], [1, -1], [1, 1], [-1, 1]].map(([a, b]) => [a * half[0], b * half[1], reach]);
    for (const corner of corners) stroke([[0, 0, 0], corner], colour("--rule"));
    stroke([...corners, corners[0]], colour("--rule"));
    const ends = [["--x", 0], ["--y", 1], ["--z", 2]];
    for (const [name, k] of ends) stroke([[0, 0, 0], [0, 1, 2].map((i) => (i === k ? 0.07 * reach : 0))], colour(name), 2);
    for (const beacon of beacons) {
      const { t_m: t, R } = beacon.pose;
      const moved = (p) => [0, 1, 2].map((i) => R[3 * i] * p[0] + R[3 * i + 1] * p[1] + R[3 * i + 2] * p[2] + t[i]);
      pen.globalAlpha = beacon.status === "ok" ? 1 : 0.4;
      stroke([[0, 0, 0], t], colour("--faint"));
      for (const [name, k] of ends) stroke([t, moved([0, 1, 2].map((i) => (i === k ? 0.14 * reach : 0)))], colour(name), 2.5);
      pen.fillStyle = colour("--ink");
      for (const point of (leds[beacon.name] || {}).positions_m || []) {
        const [u, v] = at(moved(point));
        pen.beginPath(); pen.arc(u, v, 2.5, 0, 7); pen.fill();
      }
      const [u, v] = at(t);
      pen.font = "12px system-ui, sans-serif";
      pen.fillText(beacon.status === "held" ? `${beacon.name} (held)` : beacon.name, Math.min(u + 8, width - 70), v - 10);
      pen.globalAlpha = 1;
    }
    pen.lineWidth = 1;
    pen.fillStyle = colour("--faint");
    pen.font = "12px system-ui, sans-serif";
    pen.fillText(`${reach.toFixed(2)} m`, width - 60, height - 6);
  }

  return { marks, zoom, curve, space };
})();
