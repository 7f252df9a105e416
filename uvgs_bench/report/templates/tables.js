// Tables that can be sorted. Without this script they stand in the order they were written in.
(function () {
  "use strict";
  function raw(cell) {
    var value = cell.getAttribute("data-v");
    return value === null ? null : Number(value);
  }
  function compare(a, b) {
    var x = raw(a), y = raw(b);
    if (x !== null && y !== null) return x - y;
    // Cells without a number stand last, whichever way the others run.
    if (x !== null || y !== null) return x === null ? Infinity : -Infinity;
    return a.textContent.trim().localeCompare(b.textContent.trim(), "en", { numeric: true });
  }
  function sort(table, column, way, written) {
    var body = table.tBodies[0];
    var rows = written.slice();
    if (way !== "none") {
      var sign = way === "ascending" ? 1 : -1;
      rows.sort(function (p, q) {
        var by = compare(p.cells[column], q.cells[column]);
        return Math.abs(by) === Infinity ? (by > 0 ? 1 : -1) : sign * by;
      });
    }
    rows.forEach(function (row) { body.appendChild(row); });
  }
  function isAlike(rows, column) {
    // Numbers of different units have no order.
    var units = rows.map(function (row) {
      var unit = row.cells[column].querySelector(".unit");
      return raw(row.cells[column]) === null ? null : unit ? unit.textContent : "";
    }).filter(function (unit) { return unit !== null; });
    return units.every(function (unit) { return unit === units[0]; });
  }
  document.querySelectorAll("table.sortable").forEach(function (table) {
    var written = Array.prototype.slice.call(table.tBodies[0].rows);
    var heads = Array.prototype.slice.call(table.tHead.rows[0].cells);
    heads = heads.map(function (head, column) { return isAlike(written, column) ? head : null; });
    var sortable = heads.filter(function (head) { return head; });
    heads.forEach(function (head, column) {
      if (!head) return;
      var button = document.createElement("button");
      button.type = "button";
      button.className = "sort";
      while (head.firstChild) button.appendChild(head.firstChild);
      head.appendChild(button);
      head.setAttribute("aria-sort", "none");
      button.addEventListener("click", function () {
        var next = { none: "ascending", ascending: "descending", descending: "none" }[head.getAttribute("aria-sort")];
        sortable.forEach(function (other) { other.setAttribute("aria-sort", "none"); });
        head.setAttribute("aria-sort", next);
        sort(table, column, next, written);
      });
    });
  });
})();
