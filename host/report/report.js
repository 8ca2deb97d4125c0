// Hover and zoom of a report's charts. The page is complete without it: chart.cpp draws everything, and gives
// each series' samples in data-p (see samples.hpp).
(() => {
  "use strict";
  const kReach_px = 30;  // from the pointer to a sample that it shows
  const kMostZoom = 50;
  const numbers = (text) => text.split(" ").map(Number);
  const clamp = (x, low, high) => Math.min(Math.max(x, low), high);

  // The columns of a series, each a Float64Array; NaN is a break.
  function decode(path) {
    const shares = new Uint16Array(Uint8Array.from(atob(path.dataset.p), (c) => c.charCodeAt(0)).buffer);
    const bounds = numbers(path.dataset.b);
    const columns = bounds.length / 2;
    const values = [];
    for (let k = 0; k < columns; ++k) {
      const low = bounds[2 * k], step = (bounds[2 * k + 1] - low) / 65534;
      values.push(Float64Array.from({length: shares.length / columns}, (_, i) => {
        const share = shares[i * columns + k];
        return share === 65535 ? NaN : low + step * share;
      }));
    }
    return {path, name: path.dataset.n, whole: path.getAttribute("d"), is_line: path.classList.contains("line"),
            x: values[0], y: values[1], t: values[2]};
  }

  function steps(low, high, wanted) {
    const raw = (high - low) / wanted, power = 10 ** Math.floor(Math.log10(raw));
    const step = power * ([1, 2, 5].find((factor) => raw <= factor * power * 1.0001) || 10);
    const digits = Math.max(0, Math.ceil(-Math.log10(step) - 1e-9)), ticks = [];
    for (let i = Math.ceil(low / step); i * step <= high; ++i)
      ticks.push([i * step, (i * step).toFixed(digits).replace(/^-(0\.?0*)$/, "$1")]);
    return ticks;
  }
  // Ticks of a logarithmic axis; low and high are logarithms.
  function decades(low, high, wanted) {
    if (high - low < 0.7)
      return steps(10 ** low, 10 ** high, wanted).map(([value, text]) => [Math.log10(value), text]);
    const ticks = [];
    for (let decade = Math.floor(low); decade <= high; ++decade) {
      for (let times = 1; times <= 9; ++times) {
        const at = decade + Math.log10(times), value = times * 10 ** decade;
        const has_number = times === 1 || (high - low < 2 && (times === 2 || times === 5));
        if (at >= low && at <= high) ticks.push([at, has_number ? String(Number(value.toPrecision(3))) : ""]);
      }
    }
    return ticks;
  }

  const tip = document.createElement("div");
  tip.className = "tip";
  tip.hidden = true;
  function show_tip(event, lines) {
    tip.hidden = lines.length === 0;
    tip.textContent = lines.join("\n");
    const right = event.clientX + 16 + tip.offsetWidth > innerWidth;
    tip.style.left = `${right ? Math.max(event.clientX - 16 - tip.offsetWidth, 0) : event.clientX + 16}px`;
    tip.style.top = `${clamp(event.clientY + 12, 0, Math.max(innerHeight - tip.offsetHeight, 0))}px`;
  }

  // The wheel goes on scrolling the page while it does.
  let scrolled_ms = -1e9;
  addEventListener("scroll", () => { scrolled_ms = performance.now(); }, {passive: true});

  const charts = [];
  class Chart {
    constructor(root) {
      const part = (css) => root.querySelector(css);
      this.plot = part(".plot");
      this.area = part(".area");
      this.data = part(".data");
      this.grid = part(".grid");
      this.ticks = part(".ticks");
      this.full = numbers(root.dataset.box);  // x from, x to, y from, y to; of a logarithmic axis the logarithms
      this.view = [...this.full];
      this.size = numbers(root.dataset.size);
      this.is_map = "map" in root.dataset;
      this.is_log = "log" in root.dataset;
      this.is_time = "time" in root.dataset;
      this.is_named = "named" in root.dataset;
      [this.x_label, this.y_label] = root.dataset.labels.split("|");
      this.series = [...root.querySelectorAll("[data-p]")].map(decode);
      this.marks = [...root.querySelectorAll(".at")].map((element) => ({element, at: numbers(element.dataset.at)}));
      for (const title of root.querySelectorAll("[data-hint] > title")) title.remove();
      this.whole = [this.grid.innerHTML, this.ticks.innerHTML];
      this.cursor = this.add("line", {class: "cursor", y1: 0, y2: "100%", visibility: "hidden"}, this.area);
      this.dot = this.add("circle", {class: "dot", r: 5, visibility: "hidden"}, this.area);
      this.select = this.add("rect", {class: "select", visibility: "hidden"}, this.area);
      this.all = document.createElement("button");
      this.all.className = "all";
      this.all.textContent = "show all";
      this.all.hidden = true;
      this.plot.append(this.all);
      this.all.onclick = () => this.zoom_to(this.full);
      this.area.ondblclick = () => this.zoom_to(this.full);
      this.area.addEventListener("wheel", (event) => this.wheel(event), {passive: false});
      this.area.onpointerdown = (event) => this.press(event);
      this.area.onpointermove = (event) => this.move(event);
      this.area.onpointerup = (event) => this.release(event);
      this.area.onpointercancel = () => { this.drag = null; this.leave(); };
      this.area.onpointerleave = () => this.leave();
    }
    add(name, attributes, parent) {
      const element = document.createElementNS(this.area.namespaceURI, name);
      for (const key in attributes) element.setAttribute(key, attributes[key]);
      parent.append(element);
      return element;
    }

    // Shares of the area, from its upper left corner.
    share_of(event) {
      const box = this.area.getBoundingClientRect();
      return [clamp((event.clientX - box.left) / box.width, 0, 1), clamp((event.clientY - box.top) / box.height, 0, 1)];
    }
    shares(x, y) {
      const [x0, x1, y0, y1] = this.view;
      return [(x - x0) / (x1 - x0), (y1 - y) / (y1 - y0)];
    }
    at_share([u, v]) {
      const [x0, x1, y0, y1] = this.view;
      return [x0 + u * (x1 - x0), y1 - v * (y1 - y0)];
    }

    // Shows the part of the plane nearest to `view` that this chart has; charts over time share x.
    zoom_to(view) {
      this.set_view(view);
      if (!this.is_time) return;
      for (const other of charts) {
        if (other === this || !other.is_time || view[0] >= other.full[1] || view[1] <= other.full[0]) continue;
        const all = view === this.full;
        other.set_view(all ? other.full : [view[0], view[1], other.view[2], other.view[3]]);
      }
    }
    set_view(view) {
      const next = [...view];
      for (const k of [0, 2]) {
        const whole = this.full[k + 1] - this.full[k];
        const span = clamp(view[k + 1] - view[k], whole / kMostZoom, whole);
        next[k] = clamp((view[k] + view[k + 1] - span) / 2, this.full[k], this.full[k + 1] - span);
        next[k + 1] = next[k] + span;
      }
      this.view = next;
      this.is_due || requestAnimationFrame(() => { this.is_due = false; this.draw(); });
      this.is_due = true;
    }

    draw() {
      const [x0, x1, y0, y1] = this.view, [f0, f1, g0, g1] = this.full, [width, height] = this.size;
      const is_whole = this.view.every((end, k) => Math.abs(end - this.full[k]) < 1e-9 * (this.full[k | 1] - this.full[k & 2]));
      const x_of = (x) => (x - f0) / (f1 - f0) * width, y_of = (y) => (g1 - y) / (g1 - g0) * height;
      this.all.hidden = is_whole;
      this.data.setAttribute("viewBox", [x_of(x0), y_of(y1), x_of(x1) - x_of(x0), y_of(y0) - y_of(y1)].join(" "));
      const pixel = [(x_of(x1) - x_of(x0)) / (this.area.clientWidth || width), (y_of(y0) - y_of(y1)) / (this.area.clientHeight || height)];
      for (const series of this.series)
        series.path.setAttribute("d", is_whole ? series.whole : this.path_of(series, x_of, y_of, pixel));
      for (const {element, at} of this.marks) {
        const [u, v] = this.shares(...at);
        element.setAttribute("x", `${100 * u}%`);
        element.setAttribute("y", `${100 * v}%`);
        element.setAttribute("display", u >= 0 && u <= 1 && v >= 0 && v <= 1 ? "inline" : "none");
      }
      if (is_whole) {
        [this.grid.innerHTML, this.ticks.innerHTML] = this.whole;
        return;
      }
      this.grid.replaceChildren();
      if (this.is_named) {
        for (const tick of this.ticks.querySelectorAll(".y")) tick.remove();
        [...this.ticks.children].forEach((tick, i) => this.place_tick(tick, this.shares(i, 0)[0], "left"));
      } else {
        this.ticks.replaceChildren();
        this.add_ticks("x", steps(x0, x1, this.area.clientWidth / 80));
      }
      const wanted = this.area.clientHeight / (this.is_map ? 75 : 45);
      this.add_ticks("y", this.is_log ? decades(y0, y1, wanted) : steps(y0, y1, wanted));
    }
    place_tick(tick, share, side) {
      tick.style[side] = `${100 * share}%`;
      tick.hidden = share < 0 || share > 1;
    }
    add_ticks(axis, ticks) {
      for (const [value, text] of ticks) {
        const share = axis === "x" ? this.shares(value, 0)[0] : this.shares(0, value)[1], at = `${100 * share}%`;
        const line = axis === "x" ? {x1: at, x2: at, y1: 0, y2: "100%"} : {x1: 0, x2: "100%", y1: at, y2: at};
        this.add("line", line, this.grid);
        const tick = document.createElement("i");
        tick.className = axis;
        tick.textContent = text;
        this.place_tick(tick, share, axis === "x" ? "left" : "top");
        this.ticks.append(tick);
      }
    }
    // In units of the view box; a point closer than half a pixel to the last one is left out.
    path_of(series, x_of, y_of, pixel) {
      const parts = [];
      let last = null;
      for (let i = 0; i < series.x.length; ++i) {
        const x = x_of(series.x[i]), y = y_of(series.y[i]);
        if (Number.isNaN(x + y)) { last = null; continue; }
        if (last && series.is_line && Math.hypot((x - last[0]) / pixel[0], (y - last[1]) / pixel[1]) < 0.5) continue;
        parts.push(last && series.is_line ? "L" : "M", x.toFixed(2), " ", y.toFixed(2), series.is_line ? "" : "h0");
        last = [x, y];
      }
      return parts.join("");
    }

    wheel(event) {
      if (performance.now() - scrolled_ms < 300 || event.ctrlKey) return;
      event.preventDefault();
      const factor = Math.exp(clamp(event.deltaY, -200, 200) * (event.deltaMode ? 0.05 : 0.002));
      const at = this.at_share(this.share_of(event));
      const around = (k) => [0, 1].map((end) => at[k] + (this.view[2 * k + end] - at[k]) * factor);
      this.zoom_to([...around(0), ...(this.is_map ? around(1) : this.view.slice(2))]);
      this.leave();
    }
    press(event) {
      if (event.pointerType === "touch" || event.button !== 0) return;
      this.drag = {from: this.share_of(event), view: [...this.view], moves: event.shiftKey, id: event.pointerId};
      event.preventDefault();
    }
    // The part that a drag to `to` selects; on a map it keeps the proportions.
    selection(to) {
      const {from} = this.drag, box = this.area.getBoundingClientRect();
      let [left, right] = [from[0], to[0]].sort((a, b) => a - b), [top, bottom] = [from[1], to[1]].sort((a, b) => a - b);
      if (this.is_map) {
        const size = Math.max(right - left, bottom - top);
        left = clamp((left + right - size) / 2, 0, 1 - size), right = left + size;
        top = clamp((top + bottom - size) / 2, 0, 1 - size), bottom = top + size;
      } else if ((bottom - top) * box.height < 20) {
        [top, bottom] = [0, 1];
      }
      return [left, top, right, bottom];
    }
    move(event) {
      if (!this.drag) return this.hover(event);
      const to = this.share_of(event), box = this.area.getBoundingClientRect(), {from, view} = this.drag;
      if (!this.drag.is_far && Math.hypot((to[0] - from[0]) * box.width, (to[1] - from[1]) * box.height) < 6) return;
      if (!this.drag.is_far) this.area.setPointerCapture(this.drag.id);
      this.drag.is_far = true;
      this.leave();
      if (this.drag.moves) {
        const dx = (from[0] - to[0]) * (view[1] - view[0]), dy = (to[1] - from[1]) * (view[3] - view[2]);
        this.zoom_to([view[0] + dx, view[1] + dx, view[2] + dy, view[3] + dy]);
        return;
      }
      const [left, top, right, bottom] = this.selection(to).map((share) => 100 * share);
      const box_of = {x: `${left}%`, y: `${top}%`, width: `${right - left}%`, height: `${bottom - top}%`, visibility: "visible"};
      for (const key in box_of) this.select.setAttribute(key, box_of[key]);
    }
    release(event) {
      const drag = this.drag;
      this.select.setAttribute("visibility", "hidden");
      if (drag && drag.is_far && !drag.moves) {
        const [left, top, right, bottom] = this.selection(this.share_of(event));
        const [x0, y1] = this.at_share([left, top]), [x1, y0] = this.at_share([right, bottom]);
        this.zoom_to([x0, x1, y0, y1]);
      }
      this.drag = null;
    }

    value(y) { return String(Number((this.is_log ? 10 ** y : y).toPrecision(4))); }
    hover(event) {
      const share = this.share_of(event), [x, y] = this.at_share(share);
      const hinted = event.target.closest("[data-hint]");
      const width = this.area.clientWidth, height = this.area.clientHeight;
      const lines = [];
      if (this.is_time) {
        lines.push(`${x.toFixed(2)} s`);
        for (const series of this.series.filter((one) => one.is_line && one.name)) {
          const i = this.nearest(series, ([u]) => Math.abs(u - share[0]) * width);
          if (i >= 0) lines.push(`${series.name}: ${this.value(series.y[i])}`);
        }
        for (const chart of charts) chart.point_at(x);
      }
      if (hinted) lines.push(hinted.dataset.hint);
      if (!hinted || this.is_time) {
        let best = null;
        for (const series of this.series.filter((one) => !this.is_time || !one.is_line)) {
          const i = this.nearest(series, ([u, v]) => Math.hypot((u - share[0]) * width, (v - share[1]) * height));
          if (i >= 0 && (!best || this.distance < best.distance)) best = {series, i, distance: this.distance};
        }
        if (best) lines.push(...this.describe(best));
      }
      show_tip(event, lines);
    }
    // The series' sample with the least distance within reach, else -1.
    nearest(series, distance_px) {
      let best = -1;
      this.distance = kReach_px;
      for (let i = 0; i < series.x.length; ++i) {
        if (Number.isNaN(series.y[i])) continue;
        const d = distance_px(this.shares(series.x[i], series.y[i]));
        if (d < this.distance) [best, this.distance] = [i, d];
      }
      return best;
    }
    describe({series, i}) {
      const x = String(Number(series.x[i].toPrecision(5)));
      const place = `${this.x_label}: ${x}\n${this.y_label}: ${this.value(series.y[i])}`;
      if (series.t) for (const chart of charts) chart.point_at(series.t[i]);
      return [series.name, series.t ? `${series.t[i].toFixed(2)} s` : "", place].filter((line) => line);
    }
    // Marks the time in a chart over time, and the place at that time on a map.
    point_at(t_s) {
      if (this.is_time) {
        const at = `${100 * this.shares(t_s, 0)[0]}%`;
        for (const [key, value] of [["x1", at], ["x2", at], ["visibility", "visible"]]) this.cursor.setAttribute(key, value);
      }
      const path = this.series.find((series) => series.t);
      if (!path) return;
      let best = -1;
      path.t.forEach((t, i) => { if (!Number.isNaN(path.x[i]) && (best < 0 || Math.abs(t - t_s) < Math.abs(path.t[best] - t_s))) best = i; });
      if (best < 0) return;
      const [u, v] = this.shares(path.x[best], path.y[best]);
      for (const [key, value] of [["cx", `${100 * u}%`], ["cy", `${100 * v}%`], ["visibility", "visible"]]) this.dot.setAttribute(key, value);
    }
    leave() {
      tip.hidden = true;
      for (const chart of charts) {
        chart.cursor.setAttribute("visibility", "hidden");
        chart.dot.setAttribute("visibility", "hidden");
      }
    }
  }

  document.body.append(tip);
  for (const root of document.querySelectorAll(".chart")) charts.push(new Chart(root));
  document.body.classList.add("live");
  for (const text of document.querySelectorAll(".howto")) text.hidden = false;
  addEventListener("resize", () => { for (const chart of charts) if (!chart.all.hidden) chart.draw(); });
  // A link into a closed part opens it; paper shows all parts.
  const open_target = () => { const part = document.getElementById(decodeURIComponent(location.hash.slice(1))); if (part) part.open = true; };
  addEventListener("hashchange", open_target);
  addEventListener("beforeprint", () => { for (const part of document.querySelectorAll("details")) part.open = true; });
})();
