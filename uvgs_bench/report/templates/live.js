// Drawings that turn and zoom, made from the numbers of the page. Without this script the drawings beneath stand.
(function () {
  "use strict";
  var redraws = [];
  function css(name) { return getComputedStyle(document.documentElement).getPropertyValue(name).trim(); }
  function make(parent, tag, name) {
    var element = document.createElement(tag);
    if (name) element.className = name;
    parent.appendChild(element);
    return element;
  }
  function frame(figure, data) {
    var box = make(figure, "div", "live");
    figure.insertBefore(box, figure.querySelector("figcaption"));
    figure.classList.add("is-live");
    var bar = make(box, "div", "bar");
    bar.setAttribute("role", "group");
    bar.setAttribute("aria-label", "Controls of the drawing");
    return {
      box: box,
      button: function (text, label, act) {
        var button = make(bar, "button");
        button.type = "button";
        button.textContent = text;
        button.title = label;
        button.setAttribute("aria-label", label);
        button.addEventListener("click", act);
        return button;
      }
    };
  }
  function columns(data) { return data.series.map(function (s) { return s.values; }); }

  // ---- space: stations by the colour of their errors, with error vectors ----
  var CIVIDIS = ["00224e", "1a386f", "434e6c", "61656f", "7d7c78", "9b9476", "bcae6c", "dec958", "fee838"];
  function colourAt(share) {
    var at = Math.max(0, Math.min(1, share)) * (CIVIDIS.length - 1), n = Math.min(Math.floor(at), CIVIDIS.length - 2);
    var part = at - n, out = [0, 2, 4].map(function (k) {
      var from = parseInt(CIVIDIS[n].slice(k, k + 2), 16), to = parseInt(CIVIDIS[n + 1].slice(k, k + 2), 16);
      return Math.round(from + part * (to - from));
    });
    return "rgb(" + out.join(",") + ")";
  }
  function space(figure, data) {
    var c = columns(data), count = c[0].length, low = [1e9, 1e9, 1e9], high = [-1e9, -1e9, -1e9], k, i;
    for (k = 0; k < 3; k++) {
      for (i = 0; i < count; i++) { low[k] = Math.min(low[k], c[k][i]); high[k] = Math.max(high[k], c[k][i]); }
    }
    var size = Math.max(Math.hypot(high[0] - low[0], high[1] - low[1], high[2] - low[2]), 1e-6);
    var middle = [0, 1, 2].map(function (n) { return 0.5 * (low[n] + high[n]); });
    var first = c[8][0], fits = c[7];
    var measures = [
      { name: "Position", unit: "mm", values: c[3].map(function (e, n) { return Math.hypot(e, c[4][n], c[5][n]); }) },
      { name: "Lateral", unit: "mm", values: c[3].map(function (e, n) { return Math.hypot(e, c[4][n]); }) },
      { name: "Depth", unit: "mm", values: c[5].map(Math.abs) },
      { name: "Attitude", unit: "deg", values: c[6] }
    ];
    measures.forEach(function (m) {
      // The scale serves the stations that judge; what is beyond its end wears the last colour.
      var sorted = m.values.filter(function (v, n) { return !fits[n]; }).sort(function (a, b) { return a - b; });
      m.top = sorted[Math.min(sorted.length - 1, Math.floor(sorted.length < 50 ? sorted.length : 0.98 * sorted.length))] || 1;
      m.open = sorted[sorted.length - 1] > m.top;
    });
    var ui = frame(figure, data);
    var canvas = make(ui.box, "canvas");
    canvas.tabIndex = 0;
    canvas.setAttribute("role", "img");
    canvas.setAttribute("aria-label", data.alt + " Arrow keys turn the view, plus and minus change its size.");
    var said = make(ui.box, "output");
    var view, by = measures[0], buttons;
    function reset() { view = { turn: -0.5, lift: 0.38, zoom: 1, times: first }; draw(); }
    function project(x, y, z) {
      // Camera axes: x right, y down, z forward. The eye turns about the vertical, then looks down a little.
      var a = x - middle[0], b = z - middle[2], up = -(y - middle[1]);
      var s = Math.sin(view.turn), t = Math.cos(view.turn);
      var right = a * t - b * s, away = a * s + b * t;
      var p = Math.sin(view.lift), q = Math.cos(view.lift);
      var scale = view.zoom * 0.86 * Math.min(canvas.clientWidth, 1.25 * (canvas.clientHeight - 40)) / size;
      return [
        canvas.clientWidth / 2 + scale * right,
        (canvas.clientHeight - 40) / 2 - scale * (up * q + away * p),
        away * q - up * p
      ];
    }
    function line(g, from, to) { g.beginPath(); g.moveTo(from[0], from[1]); g.lineTo(to[0], to[1]); g.stroke(); }
    function bar(g, width, height) {
      var across = Math.min(320, width - 90), left = (width - across) / 2, top = height - 30, n;
      for (n = 0; n < 64; n++) {
        g.fillStyle = colourAt((n + 0.5) / 64);
        g.fillRect(left + across * n / 64, top, across / 64 + 1, 9);
      }
      g.fillStyle = css("--ink");
      g.textAlign = "center";
      g.fillText("0", left, top + 22);
      g.fillText((0.5 * by.top).toPrecision(2), left + across / 2, top + 22);
      g.fillText(by.top.toPrecision(2) + " " + by.unit + (by.open ? " and more" : ""), left + across, top + 22);
      g.textAlign = "start";
    }
    function draw() {
      var dots = window.devicePixelRatio || 1, width = canvas.clientWidth, height = canvas.clientHeight;
      if (!width) return;
      canvas.width = Math.round(width * dots);
      canvas.height = Math.round(height * dots);
      var g = canvas.getContext("2d");
      g.scale(dots, dots);
      g.font = "12px system-ui, sans-serif";
      g.lineWidth = 1;
      g.strokeStyle = css("--rule");
      for (var n = 0; n < 8; n++) {
        for (var axis = 0; axis < 3; axis++) {
          if (n & (1 << axis)) continue;
          var at = [0, 1, 2].map(function (m) { return n & (1 << m) ? high[m] : low[m]; }), other = at.slice();
          other[axis] = high[axis];
          line(g, project.apply(null, at), project.apply(null, other));
        }
      }
      g.fillStyle = css("--ink");
      ["x right", "y down", "z forward"].forEach(function (name, axis) {
        var at = [low[0], high[1], low[2]], end = at.slice();
        end[axis] = axis === 1 ? low[1] : high[axis];
        var from = project.apply(null, at), to = project.apply(null, end);
        g.fillText(name + " " + low[axis].toFixed(2) + " to " + high[axis].toFixed(2) + " m",
          Math.max(4, Math.min(width - 150, 0.5 * (from[0] + to[0]))), 0.5 * (from[1] + to[1]) + 14);
      });
      var order = [], spots = [], m = view.times / 1000;
      for (i = 0; i < count; i++) { spots.push(project(c[0][i], c[1][i], c[2][i])); order.push(i); }
      order.sort(function (a, b) { return spots[b][2] - spots[a][2]; });
      g.strokeStyle = css("--faint");
      order.forEach(function (j) {
        var p = spots[j], share = by.values[j] / by.top, r = 2.4 + 2.6 * Math.min(1, share);
        line(g, p, project(c[0][j] + m * c[3][j], c[1][j] + m * c[4][j], c[2][j] + m * c[5][j]));
        g.fillStyle = colourAt(share);
        g.beginPath();
        if (fits[j]) g.rect(p[0] - r, p[1] - r, 2 * r, 2 * r); else g.arc(p[0], p[1], r, 0, 7);
        g.fill();
        g.stroke();
      });
      bar(g, width, height);
      canvas.spots = spots;
      said.textContent = by.name + " error by colour (mean of a station). Discs judge, squares fitted the registration. " +
        "Lines: mean position error, " + Number(view.times.toPrecision(2)) + " times as long as true.";
    }
    function turn(by, up) {
      view.turn += by;
      view.lift = Math.max(-1.57, Math.min(1.57, view.lift + up));
      draw();
    }
    function larger(times) { view.zoom *= times; draw(); }
    buttons = measures.map(function (m) {
      return ui.button(m.name, "Colour by " + m.name.toLowerCase() + " error", function () {
        by = m;
        buttons.forEach(function (b, n) { b.setAttribute("aria-pressed", measures[n] === by); });
        draw();
      });
    });
    buttons.forEach(function (b, n) { b.setAttribute("aria-pressed", n === 0); });
    ui.button("◀", "Turn left", function () { turn(-0.2, 0); });
    ui.button("▶", "Turn right", function () { turn(0.2, 0); });
    ui.button("▲", "Look from higher", function () { turn(0, 0.15); });
    ui.button("▼", "Look from lower", function () { turn(0, -0.15); });
    ui.button("+", "Larger", function () { larger(1.25); });
    ui.button("−", "Smaller", function () { larger(0.8); });
    ui.button("Longer lines", "Longer error vectors", function () { view.times *= 1.5; draw(); });
    ui.button("Shorter lines", "Shorter error vectors", function () { view.times /= 1.5; draw(); });
    ui.button("Reset", "First view", reset);
    canvas.addEventListener("keydown", function (event) {
      var move = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] }[event.key];
      if (move) { turn(move[0], move[1]); event.preventDefault(); }
      if (event.key === "+" || event.key === "-") { larger(event.key === "+" ? 1.25 : 0.8); event.preventDefault(); }
    });
    var held = null;
    canvas.addEventListener("pointerdown", function (event) {
      held = [event.clientX, event.clientY];
      canvas.setPointerCapture(event.pointerId);
    });
    ["pointerup", "pointercancel"].forEach(function (name) { canvas.addEventListener(name, function () { held = null; }); });
    canvas.addEventListener("pointermove", function (event) {
      if (held) {
        turn((event.clientX - held[0]) * 0.01, (event.clientY - held[1]) * 0.01);
        held = [event.clientX, event.clientY];
        return;
      }
      var best = -1, near = 144;
      canvas.spots.forEach(function (p, j) {
        var d = Math.pow(p[0] - event.offsetX, 2) + Math.pow(p[1] - event.offsetY, 2);
        if (d < near) { near = d; best = j; }
      });
      if (best >= 0) {
        said.textContent = "x " + c[0][best].toFixed(3) + ", y " + c[1][best].toFixed(3) + ", z " +
          c[2][best].toFixed(3) + " m: mean error " + measures[0].values[best].toFixed(3) + " mm (x " +
          c[3][best].toFixed(3) + ", y " + c[4][best].toFixed(3) + ", z " + c[5][best].toFixed(3) + "), attitude " +
          c[6][best].toFixed(4) + " deg; " + (fits[best] ? "fitted the registration" : "judges");
      }
    });
    reset();
    redraws.push(draw);
  }

  // ---- zoom: series over time, one chart a unit, cursors together ----
  var COLOURS = ["--blue", "--orange", "--green", "--purple"];
  function zoom(figure, data) {
    var ui = frame(figure, data), groups = [], units = [];
    data.series.forEach(function (s) {
      if (s.unit === "s") { groups.push({ x: s.values, ys: [] }); return; }
      groups[groups.length - 1].ys.push(s);
      if (units.indexOf(s.unit) < 0) units.push(s.unit);
    });
    var whole = [Infinity, -Infinity];
    groups.forEach(function (group) {
      group.x.forEach(function (t) { whole = [Math.min(whole[0], t), Math.max(whole[1], t)]; });
    });
    var charts = units.map(function (unit) {
      var names = [], tables = [];
      groups.forEach(function (group) {
        var mine = group.ys.filter(function (s) { return s.unit === unit; });
        if (!mine.length) return;
        tables.push([group.x].concat(mine.map(function (s) { return s.values; })));
        names = names.concat(mine.map(function (s) { return s.name; }));
      });
      var place = make(ui.box, "div");
      var axis = { stroke: function () { return css("--faint"); }, grid: { stroke: function () { return css("--rule"); } },
        ticks: { stroke: function () { return css("--rule"); } } };
      var chart = new uPlot({
        width: ui.box.clientWidth || 300, height: 240,
        cursor: { sync: { key: data.key }, drag: { x: true, y: false } },
        scales: { x: { time: false } },
        axes: [Object.assign({ label: "time since the first capture (s)" }, axis), Object.assign({ label: unit }, axis)],
        series: [{ label: "s", value: function (u, v) { return v === null ? "–" : v.toFixed(2); } }].concat(
          names.map(function (name, n) {
            var colour = / in sample$/.test(name) ? "--yellow" : COLOURS[n % COLOURS.length];
            return { label: name + " (" + unit + ")", paths: function () { return null; }, show: n < 1 || n === names.length - 1,
              stroke: function () { return css(colour); },
              points: { show: true, size: 4, fill: function () { return css(colour); } },
              value: function (u, v) { return v === null || v === undefined ? "–" : v.toPrecision(4); } };
          }))
      }, uPlot.join(tables), place);
      return { chart: chart };
    });
    function show(low, high) {
      charts.forEach(function (one) { one.chart.setScale("x", { min: low, max: high }); });
    }
    function shown() { var x = charts[0].chart.scales.x; return [x.min, x.max]; }
    function around(factor, shift) {
      var now = shown(), middle = 0.5 * (now[0] + now[1]), half = 0.5 * (now[1] - now[0]);
      middle += shift * half;
      show(middle - factor * half, middle + factor * half);
    }
    ui.button("+", "Zoom in", function () { around(0.6, 0); });
    ui.button("−", "Zoom out", function () { around(1 / 0.6, 0); });
    ui.button("◀", "Earlier", function () { around(1, -0.5); });
    ui.button("▶", "Later", function () { around(1, 0.5); });
    ui.button("Whole run", "Whole run", function () { show(whole[0], whole[1]); });
    redraws.push(function () {
      charts.forEach(function (one) {
        one.chart.setSize({ width: ui.box.clientWidth, height: 240 });
        one.chart.redraw();
      });
    });
  }

  document.querySelectorAll("script[data-live]").forEach(function (block) {
    var data = JSON.parse(block.textContent), figure = document.getElementById(data.key);
    if (data.live === "space") space(figure, data);
    if (data.live === "zoom" && window.uPlot) zoom(figure, data);
  });
  function all() { redraws.forEach(function (redraw) { redraw(); }); }
  window.addEventListener("resize", all);
  window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", all);
})();
