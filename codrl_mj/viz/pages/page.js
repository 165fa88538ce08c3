"use strict";
/* Clock, films and plots of a page. uPlot draws each plot when it becomes visible. */
const codrl = (() => {
  const root = document.documentElement;
  const css = (name) => getComputedStyle(root).getPropertyValue(name).trim();
  const clamp = (value, low, high) => Math.min(Math.max(value, low), high);
  const make = (tag, attributes = {}, ...children) => {
    const element = document.createElement(tag);
    for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
    element.append(...children);
    return element;
  };
  const number = (value) => {
    if (value == null || Number.isNaN(value)) return "–";
    const size = Math.abs(value);
    const text = value === 0 ? "0" : size >= 1e7 || size < 1e-4 ? Number(value.toPrecision(3)).toExponential()
      : String(Number(value.toPrecision(4)));
    return text.replace(/-/g, "\u2212");
  };
  const tick = (value) => {
    const size = Math.abs(value);
    return size >= 1e6 && size < 1e9 ? number(value / 1e6) + "M" : size >= 1e4 && size < 1e6 ? number(value / 1e3) + "k" : number(value);
  };
  const superscripts = "⁰¹²³⁴⁵⁶⁷⁸⁹";
  const power = (value) => {
    const exponent = Math.round(Math.log10(value));
    const digits = [...String(Math.abs(exponent))].map((digit) => superscripts[digit]).join("");
    return exponent === 0 ? "1" : exponent === 1 ? "10" : `10${exponent < 0 ? "⁻" : ""}${digits}`;
  };

  /* -- light and dark ------------------------------------------------------------------------------------- */

  const plots = [];
  const remembered = (theme) => {
    try {
      if (theme) localStorage.setItem("codrl-theme", theme);
      return localStorage.getItem("codrl-theme");
    } catch {
      return null; // a browser may forbid storage, for example to local files
    }
  };
  const dark = () => (root.dataset.theme || (matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light")) === "dark";
  const redraw = () => plots.forEach((plot) => plot.redraw());
  function themes() {
    const button = document.getElementById("theme");
    const named = () => button.setAttribute("aria-pressed", String(dark()));
    if (remembered()) root.dataset.theme = remembered();
    button.hidden = false;
    button.addEventListener("click", () => {
      root.dataset.theme = dark() ? "light" : "dark";
      remembered(root.dataset.theme);
      named();
      redraw();
    });
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { named(); redraw(); });
    named();
  }

  /* -- the clock: films, plots and other parts show the same instant ------------------------------------------ */

  const clock = { time: 0, end: 0, playing: false, speed: 1, followers: new Set(), told: new Set() };
  clock.set = (time, from = null) => {
    clock.time = clamp(time, 0, clock.end);
    for (const follow of clock.followers) if (follow !== from) follow(clock.time);
  };
  clock.play = (playing) => {
    if (playing && clock.time >= clock.end - 1e-6) clock.set(0);
    clock.playing = playing;
    clock.told.forEach((tell) => tell());
    if (playing) requestAnimationFrame(advance);
  };
  let last = null;
  function advance(now) {
    if (!clock.playing) { last = null; return; }
    const master = films.find((film) => film.leads());
    const step = last === null ? 0 : (now - last) / 1000;
    last = now;
    if (master) clock.set(master.video.currentTime, master.follow);
    else clock.set(clock.time + step * clock.speed);
    if (clock.time >= clock.end - 1e-6 || (master && master.video.ended)) {
      clock.set(clock.end);
      clock.play(false);
      last = null;
    } else requestAnimationFrame(advance);
  }

  /** Let a part of the page follow the clock.
   * @param element the part; passed to `join`
   * @param join (element, seek) -> setTime: `setTime(seconds)` shows that instant; the part calls `seek(seconds)`
   */
  function clocked(element, join) {
    const setTime = join(element, (time) => clock.set(time, setTime));
    clock.followers.add(setTime);
    setTime(clock.time);
  }

  const films = [];
  function film(video) {
    const frame = Number(video.dataset.frame);
    const own = { video };
    video.removeAttribute("controls");
    own.leads = () => !video.error && video.readyState >= 2 && !video.paused && !video.ended
      && video.duration >= clock.end - 2 * frame;
    own.follow = (time) => {
      if (!Number.isFinite(video.duration)) return;
      const wanted = Math.min(time, video.duration - frame / 2);
      const off = Math.abs(video.currentTime - wanted);
      if (clock.playing && time < video.duration ? off > 0.12 : off > frame / 4) {
        video.currentTime = clock.playing ? wanted : wanted + Math.min(frame / 2, video.duration - wanted);
      }
    };
    const drive = () => {
      video.playbackRate = clock.speed;
      if (clock.playing && clock.time < video.duration) video.play().catch(() => {}); else video.pause();
    };
    clock.followers.add(own.follow);
    clock.told.add(drive);
    const loaded = () => {
      video.currentTime = frame / 2;  // seeking replaces the poster by a frame of the film
      own.follow(clock.time);
    };
    if (video.readyState >= HTMLMediaElement.HAVE_METADATA) loaded();  // loaded before this script ran: no event will follow
    else video.addEventListener("loadedmetadata", loaded);
    video.addEventListener("click", () => clock.play(!clock.playing));
    films.push(own);
  }

  function transport(bar) {
    const play = bar.querySelector(".play"), slider = bar.querySelector("input"), shown = bar.querySelector("output");
    const speed = bar.querySelector("select");
    clock.end = Number(slider.max);
    bar.hidden = false;
    play.addEventListener("click", () => clock.play(!clock.playing));
    slider.addEventListener("input", () => clock.set(Number(slider.value)));
    speed.addEventListener("change", () => {
      clock.speed = Number(speed.value);
      clock.told.forEach((tell) => tell());
    });
    clock.told.add(() => {
      play.textContent = clock.playing ? "❚❚" : "▶";
      play.setAttribute("aria-label", clock.playing ? "Pause" : "Play");
    });
    clock.followers.add((time) => {
      slider.value = time;
      slider.setAttribute("aria-valuetext", `${time.toFixed(2)} seconds`);
      shown.textContent = `${time.toFixed(2)} / ${clock.end.toFixed(2)} s`;
    });
    for (const button of bar.querySelectorAll("[data-zoom]")) {
      button.addEventListener("click", () => plots.find((plot) => plot.clock && plot.u)?.zoomed(button.dataset.zoom));
    }
  }

  /* -- selection of runs and motors ------------------------------------------------------------------------------ */

  const hiddenTags = new Set();
  function selector(box) {
    const toggle = () => (box.checked ? hiddenTags.delete(box.value) : hiddenTags.add(box.value));
    toggle();
    box.addEventListener("change", () => {
      toggle();
      plots.forEach((plot) => plot.select());
    });
  }
  const seen = (tags) => !tags.some((tag) => hiddenTags.has(tag));

  /* -- plots ------------------------------------------------------------------------------------------------------ */

  function decoded(text) {
    const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
    return new Float32Array(bytes.buffer);
  }
  const gapped = (values) => (values.some(Number.isNaN) ? Array.from(values, (v) => (Number.isNaN(v) ? null : v)) : values);

  class Plot {
    constructor(figure) {
      this.figure = figure;
      this.box = figure.querySelector(".plot");
      this.spec = JSON.parse(figure.querySelector("script").textContent);
      this.clock = this.spec.clock;
      const arrays = this.spec.arrays.map(decoded);
      this.curves = this.spec.curves.map((curve, index) => ({
        ...curve, on: true, colour: curve.colour ?? index, x: curve.x, xs: arrays[curve.x], ys: gapped(arrays[curve.y]),
        times: curve.times === undefined ? null : arrays[curve.times],
      }));
      this.shades = this.spec.shades.map((shade) => ({ ...shade, spans: arrays[shade.spans] }));
      this.trails = this.curves.filter((curve) => curve.style === "trail");
      this.lines = this.curves.filter((curve) => curve.style !== "trail");
      this.curves.filter((curve) => curve.style === "reference").forEach((curve, rank) => { curve.rank = rank; });
      this.limits = this.spread();
      this.legend();
      plots.push(this);
    }

    spread() {
      let low = Infinity, high = -Infinity;
      for (const { xs } of this.curves) for (const x of xs) { if (x < low) low = x; if (x > high) high = x; }
      if (this.clock) [low, high] = [0, clock.end || high];
      return low < high ? [low, high] : Number.isFinite(low) ? (this.spec.x.log ? [low / 2, low * 2] : [low - 0.5, low + 0.5]) : [0, 1];
    }

    kind(curve) {
      return curve.style === "reference" ? "ref" : `c${(this.several ? curve.shared ?? curve.colour : curve.colour) % 6}`;
    }

    colour(curve) { return css(`--${this.kind(curve)}`); }

    legend() {
      this.at = make("span", { class: "at" });
      const list = make("ul", { class: "legend" }, make("li", {}, this.at));
      for (const curve of this.curves) {
        const swatch = curve.swatch = make("span", { "aria-hidden": "true" });
        curve.value = make("span", { class: "value" });
        curve.button = make("button", { type: "button", "aria-pressed": "true" }, swatch, curve.label, " ", curve.value);
        curve.button.addEventListener("click", () => {
          curve.on = !curve.on;
          curve.button.setAttribute("aria-pressed", String(curve.on));
          this.select();
        });
        curve.item = make("li", {}, curve.button);
        list.append(curve.item);
      }
      for (const shade of this.shades) {
        shade.item = make("li", { class: "shade" }, make("span", { class: "swatch shaded", "aria-hidden": "true" }), shade.label);
        shade.item.hidden = !seen(shade.tags) || !shade.spans.length;
        list.append(shade.item);
      }
      this.said = make("output", { class: "hidden", "aria-live": "polite" });
      this.box.after(list, this.said);
      this.choose();
    }

    /** Show and hide curves. Signals of a single run and motor differ in color; several runs or motors have one color each. */
    choose() {
      const shown = this.curves.filter((curve) => curve.on && seen(curve.tags));
      this.several = new Set(shown.filter((curve) => curve.shared != null).map((curve) => curve.tags.join())).size > 1;
      for (const curve of this.curves) {
        curve.item.hidden = !seen(curve.tags);
        curve.swatch.className = `swatch ${this.kind(curve)} ${curve.style} r${(curve.rank ?? 0) % 4}${curve.dashed ? " dashed" : ""}`;
        if (curve.dot) curve.dot.className = `dot ${this.kind(curve)}`;
      }
    }

    draw() {
      if (this.u) return;
      const groups = new Map();
      for (const curve of this.lines) groups.set(curve.x, [...(groups.get(curve.x) ?? []), curve]);
      let tables = [...groups.values()].map((curves) => [curves[0].xs, ...curves.map((curve) => curve.ys)]);
      const order = [...groups.values()].flat();
      if (!tables.length) tables = [[Float64Array.from(this.limits)]];
      const data = tables.length > 1 ? uPlot.join(tables) : tables[0];
      order.forEach((curve, index) => { curve.index = index + 1; });
      const axis = (side) => ({
        stroke: () => css("--soft"), grid: { stroke: () => css("--rule"), width: 1 },
        ticks: { stroke: () => css("--rule"), width: 1, size: 4 }, font: "12px system-ui, sans-serif",
        values: (u, ticks) => ticks.map(this.spec[side].log && ticks.length > 1 && ticks[1] / ticks[0] > 9 ? power : tick),
        ...(this.spec[side].log ? { splits: (u, axis, low, high) => this.decades(low, high), filter: (u, ticks) => ticks } : {}),
      });
      const passes = (clocked) => (u, target, handler) => (event) => {
        if (event.button === 0 && event.shiftKey === clocked) handler(event);
      };
      this.u = new uPlot({
        ...this.size(),
        legend: { show: false },
        padding: [8, 10, 0, 0],
        cursor: {
          y: false, drag: { x: true, y: false, setScale: true }, sync: this.clock ? { key: "clock", setSeries: false } : undefined,
          points: { size: 6 }, dataIdx: (u, series, index) => this.nearest(u, series, index),
          bind: { mousedown: passes(this.clock), dblclick: () => () => this.zoomed("reset") },
        },
        scales: {
          x: { time: false, distr: this.spec.x.log ? 3 : 1, range: (u, low, high) => this.across(low, high) },
          y: { distr: this.spec.y.log ? 3 : 1, range: (u, low, high) => this.up(low, high) },
        },
        axes: [{ ...axis("x"), space: 56, size: 28, ...(this.clock ? {} : { label: this.spec.x.label, labelSize: 20, labelGap: 0, labelFont: "12px system-ui, sans-serif" }) },
          { ...axis("y"), space: 24, size: (u, values) => this.clock ? 66 : 14 + 7 * Math.max(2, ...(values ?? []).map((text) => (text ?? "").length)) },
          ...(this.spec.scaled ? [this.beside(axis("y"), ...this.spec.scaled)] : [])],
        bands: order.filter((curve) => curve.filled).map((curve) => ({ series: [curve.index, curve.index - 1], fill: () => css("--filled"), show: true })),
        series: [{}, ...order.map((curve) => this.series(curve))],
        hooks: {
          drawClear: [(u) => this.shaded(u)], draw: [(u) => { this.trailed(u); this.now(); }],
          setCursor: [() => this.read()],
          setScale: [(u, key) => { if (key === "x" && this.clock && this.ready) this.share(); }],
        },
      }, data, this.box);
      this.line = make("div", { class: "now" });
      this.u.over.append(this.line);
      for (const [place, text] of (this.spec.corners ?? []).entries()) {
        this.u.over.append(make("span", { class: `corner ${place > 1 ? "right" : "left"} ${place % 2 ? "low" : "high"}` }, text));
      }
      for (const trail of this.trails) if (trail.times) {
        trail.dot = make("div", { class: `dot ${this.kind(trail)}` });
        this.u.over.append(trail.dot);
      }
      this.gestures();
      this.select();
      if (this.clock && clock.window) this.u.setScale("x", { min: clock.window[0], max: clock.window[1] });
      this.ready = true;
    }

    /** A second vertical axis, whose values are a multiple of those of the first. */
    beside(axis, label, scale) {
      return { ...axis, side: 1, scale: "y", grid: { show: false }, space: 24, size: 56, label, labelSize: 20, labelGap: 0,
        labelFont: "12px system-ui, sans-serif", values: (u, ticks) => ticks.map((value) => tick(scale * value)) };
    }

    size() { return { width: Math.max(this.box.clientWidth, 120), height: this.box.clientHeight }; }

    series(curve) {
      const few = curve.xs.length <= 25 && curve.style !== "reference";
      const stroke = () => this.colour(curve);
      const style = { label: curve.label, stroke, width: curve.style === "reference" ? 1.4 : 1.7, points: { show: few, size: 5, fill: stroke } };
      if (curve.style === "reference") style.dash = [[5, 4], [2, 3], [], [10, 3, 2, 3]][curve.rank % 4];
      if (curve.dashed) Object.assign(style, { dash: [7, 4], width: 1.4 });
      if (curve.style === "step") style.paths = uPlot.paths.stepped({ align: 1 });
      if (curve.style === "dots") Object.assign(style, { paths: () => null, points: { show: true, size: curve.xs.length > 200 ? 3 : 6, fill: stroke } });
      return style;
    }

    decades(low, high) {
      const span = Math.log10(high / low), every = Math.max(1, Math.ceil(span / 8)), found = [];
      for (let exponent = Math.floor(Math.log10(low)); exponent <= Math.log10(high); exponent += 1) {
        for (const part of span > 1.5 ? [1] : span > 0.7 ? [1, 2, 5] : [1, 1.5, 2, 3, 4, 5, 6, 7, 8, 9]) {
          const tick = part * 10 ** exponent;
          if (tick >= low && tick <= high && (span <= 1.5 || exponent % every === 0)) found.push(tick);
        }
      }
      return found;
    }

    across(low, high) { return low == null || !(high > low) ? this.limits : [low, high]; }

    up(low, high) {
      const [left, right] = [this.u?.scales.x.min ?? this.limits[0], this.u?.scales.x.max ?? this.limits[1]];
      for (const trail of this.trails) if (trail.on && seen(trail.tags)) trail.ys.forEach((y, index) => {
        if (y != null && trail.xs[index] >= left && trail.xs[index] <= right) {
          low = Math.min(low ?? y, y);
          high = Math.max(high ?? y, y);
        }
      });
      if (low == null || high == null) return this.spec.y.log ? [0.1, 10] : [0, 1];
      if (this.spec.y.log) {
        high = Math.min(high, this.spec.y.most ?? Infinity);
        low = Math.min(low, high);
        const room = Math.max((high / low) ** 0.05, 1.3);
        return [low / room, high * room];
      }
      if (this.spec.y.most != null) [low, high] = [Math.max(low, -this.spec.y.most), Math.min(high, this.spec.y.most)];
      const room = high > low ? 0.06 * (high - low) : Math.max(Math.abs(high) * 0.1, 1e-6);
      return [low - room, high + room];
    }

    nearest(u, series, index) {
      const values = u.data[series];
      for (let away = 0; series > 0 && away < values.length; away += 1) {
        if (values[index - away] != null) return index - away;
        if (values[index + away] != null) return index + away;
      }
      return index;
    }

    shaded(u) {
      const { left, top, width, height } = u.bbox;
      for (const shade of this.shades) {
        if (!seen(shade.tags)) continue;
        u.ctx.save();
        u.ctx.fillStyle = css("--shaded");
        for (let index = 0; index < shade.spans.length; index += 2) {
          const begin = clamp(u.valToPos(shade.spans[index], "x", true), left, left + width);
          const end = clamp(u.valToPos(shade.spans[index + 1], "x", true), left, left + width);
          if (end > begin) u.ctx.fillRect(begin, top, Math.max(end - begin, 1), height);
        }
        u.ctx.restore();
      }
    }

    trailed(u) {
      const { left, top, width, height } = u.bbox;
      for (const trail of this.trails) {
        if (!trail.on || !seen(trail.tags)) continue;
        u.ctx.save();
        u.ctx.beginPath();
        u.ctx.rect(left, top, width, height);
        u.ctx.clip();
        u.ctx.fillStyle = this.colour(trail);
        u.ctx.globalAlpha = clamp(300 / trail.xs.length, 0.15, 0.6);
        const size = (trail.xs.length <= 25 ? 7 : 3) * devicePixelRatio;
        trail.xs.forEach((x, index) => {
          if (trail.ys[index] == null) return;
          u.ctx.fillRect(u.valToPos(x, "x", true) - size / 2, u.valToPos(trail.ys[index], "y", true) - size / 2, size, size);
        });
        u.ctx.restore();
      }
    }

    now() {
      if (!this.line) return;
      const place = (element, x, y) => {
        const left = this.u.valToPos(x, "x"), top = y === undefined ? 0 : this.u.valToPos(y, "y");
        element.hidden = !(left >= -1 && left <= this.u.over.clientWidth + 1);
        element.style.transform = `translate(${left}px, ${top}px)`;
      };
      if (this.clock) place(this.line, clock.time); else this.line.hidden = true;
      for (const trail of this.trails) if (trail.dot) {
        const index = this.index(trail.times, clock.time);
        place(trail.dot, trail.xs[index], trail.ys[index]);
        trail.dot.hidden ||= !trail.on || !seen(trail.tags);
      }
    }

    index(times, time) {
      let low = 0, high = times.length - 1;
      while (low < high) {
        const middle = (low + high + 1) >> 1;
        if (times[middle] <= time + 1e-6) low = middle; else high = middle - 1;
      }
      return low;
    }

    /** Show the values under the pointer, or else those at the page's time. */
    read() {
      if (!this.u) return;
      let index = this.u.cursor.idx;
      const hovering = index != null && this.u.cursor.left >= 0;
      if (!hovering && !this.clock) {
        this.at.textContent = "";
        for (const curve of this.curves) curve.value.textContent = "";
        return;
      }
      if (!hovering) index = this.index(this.u.data[0], clock.time);
      const name = this.spec.x.label.replace(/\s*\[.*\]/, ""), unit = /\[(.*)\]/.exec(this.spec.x.label)?.[1] ?? "";
      this.at.textContent = `${name} ${number(hovering ? this.u.data[0][index] : clock.time)} ${unit}`;
      for (const curve of this.lines) {
        curve.value.textContent = number(this.u.data[curve.index][this.nearest(this.u, curve.index, index)]);
      }
    }

    select() {
      this.choose();
      for (const shade of this.shades) shade.item.hidden = !seen(shade.tags) || !shade.spans.length;
      if (!this.u) return;
      this.u.batch(() => {
        for (const curve of this.lines) this.u.setSeries(curve.index, { show: curve.on && seen(curve.tags) });
        this.u.setScale("x", { min: this.u.scales.x.min ?? this.limits[0], max: this.u.scales.x.max ?? this.limits[1] });
      });
      this.u.redraw(false);
      this.read();
    }

    redraw() { this.u?.redraw(false, true); }

    /* Zooming and panning along x, by shares of the visible range. */
    window(low, high) {
      const [least, most] = this.limits;
      const flat = this.spec.x.log ? Math.log : (x) => x, back = this.spec.x.log ? Math.exp : (x) => x;
      let [from, to] = [flat(low), flat(high)];
      const [first, final] = [flat(least), flat(most)];
      const width = clamp(to - from, (final - first) * 1e-4, final - first);
      from = clamp(from, first, final - width);
      this.u.setScale("x", { min: back(from), max: back(from + width) });
    }

    scaled(factor, shift = 0, centre = null) {
      const flat = this.spec.x.log ? Math.log : (x) => x, back = this.spec.x.log ? Math.exp : (x) => x;
      const [low, high] = [flat(this.u.scales.x.min), flat(this.u.scales.x.max)];
      const at = centre === null ? (low + high) / 2 : flat(centre);
      const move = shift * (high - low);
      this.window(back(at + (low - at) * factor + move), back(at + (high - at) * factor + move));
    }

    zoomed(how) {
      const centre = this.clock && clock.time >= this.u.scales.x.min && clock.time <= this.u.scales.x.max ? clock.time : null;
      if (how === "in") this.scaled(0.5, 0, centre);
      else if (how === "out") this.scaled(2, 0, centre);
      else if (how === "left") this.scaled(1, -0.25);
      else if (how === "right") this.scaled(1, 0.25);
      else this.window(...this.limits);
    }

    share() {
      const { min, max } = this.u.scales.x;
      clock.window = [min, max];
      for (const plot of plots) if (plot.clock && plot !== this && plot.u && (plot.u.scales.x.min !== min || plot.u.scales.x.max !== max)) {
        plot.u.setScale("x", { min, max });
      }
    }

    gestures() {
      const over = this.u.over, fingers = new Map();
      const x = (event) => this.u.posToVal(event.clientX - over.getBoundingClientRect().left, "x");
      let held = null;
      over.addEventListener("pointerdown", (event) => {
        fingers.set(event.pointerId, event.clientX);
        const touch = event.pointerType === "touch";
        if (event.button !== 0 || (event.shiftKey && this.clock) || (!this.clock && !event.shiftKey && !touch)) return;
        over.setPointerCapture(event.pointerId);
        held = this.clock ? "seek" : touch ? "read" : "pan";
        if (held === "seek") clock.set(x(event));
      });
      over.addEventListener("pointermove", (event) => {
        const before = fingers.get(event.pointerId);
        if (before === undefined) return;
        if (fingers.size === 2) {
          const [one, two] = [...fingers.values()], apart = Math.abs(one - two);
          fingers.set(event.pointerId, event.clientX);
          const [left, right] = [...fingers.values()], wide = Math.abs(left - right);
          if (wide > 8 && apart > 8) this.scaled(apart / wide, ((one + two) - (left + right)) / 2 / over.clientWidth);
          return;
        }
        fingers.set(event.pointerId, event.clientX);
        if (held === "seek") clock.set(x(event));
        if (held === "pan") this.scaled(1, (before - event.clientX) / over.clientWidth);
        if (held === "read") this.u.setCursor({ left: event.clientX - over.getBoundingClientRect().left, top: 10 });
      });
      for (const end of ["pointerup", "pointercancel"]) over.addEventListener(end, (event) => {
        fingers.delete(event.pointerId);
        held = null;
      });
      over.addEventListener("wheel", (event) => {
        if (event.ctrlKey || event.metaKey) this.scaled(event.deltaY > 0 ? 1.25 : 0.8, 0, x(event));
        else if (event.shiftKey || Math.abs(event.deltaX) > Math.abs(event.deltaY)) this.scaled(1, (event.deltaX || event.deltaY) / 600);
        else return;
        event.preventDefault();
      }, { passive: false });
      this.box.addEventListener("keydown", (event) => this.key(event));
    }

    key(event) {
      const step = { ArrowLeft: -1, ArrowRight: 1, PageDown: -10, PageUp: 10 }[event.key];
      if (step && event.shiftKey) this.zoomed(step < 0 ? "left" : "right");
      else if (step && this.clock) clock.set(clock.time + step * Math.max((this.u.scales.x.max - this.u.scales.x.min) / 200, 1e-4));
      else if (step) this.u.setCursor({ left: clamp((this.u.cursor.left < 0 ? 0 : this.u.cursor.left) + 4 * step, 0, this.u.over.clientWidth - 1), top: 10 });
      else if (event.key === "+" || event.key === "=") this.zoomed("in");
      else if (event.key === "-") this.zoomed("out");
      else if (event.key === "0" || event.key === "Home" || event.key === "Escape") this.zoomed("reset");
      else if (event.key === " " && this.clock) clock.play(!clock.playing);
      else return;
      event.preventDefault();
      this.said.textContent = `${this.at.textContent}: ${this.curves.filter((one) => !one.item.hidden && one.on && one.value.textContent)
        .map((one) => `${one.label} ${one.value.textContent}`).join(", ")}`;
    }

    /** Move the line to the clock's time, and a zoomed window with it. */
    follow(time) {
      if (!this.u) return;
      const { min, max } = this.u.scales.x;
      if (this.clock && clock.playing && (time > max || time < min)) this.window(time, time + max - min);
      this.now();
      if (this.clock && !(this.u.cursor.left >= 0)) this.read();
    }
  }

  function start() {
    themes();
    document.querySelectorAll(".transport").forEach(transport);
    document.querySelectorAll("input[data-tag]").forEach(selector);
    document.querySelectorAll("video[data-frame]").forEach(film);
    const sight = new IntersectionObserver((entries) => entries.forEach((entry) => entry.isIntersecting && entry.target.plot.draw()), { rootMargin: "400px" });
    const sizes = new ResizeObserver((entries) => entries.forEach(({ target }) => target.plot.u?.setSize(target.plot.size())));
    for (const figure of document.querySelectorAll("figure.uplotted")) {
      const plot = new Plot(figure);
      plot.box.plot = plot;
      sight.observe(plot.box);
      sizes.observe(plot.box);
      clock.followers.add((time) => plot.follow(time));
      for (const button of figure.querySelectorAll("[data-zoom]")) {
        button.addEventListener("click", () => { plot.draw(); plot.zoomed(button.dataset.zoom); });
      }
    }
    root.classList.add("scripted");
    addEventListener("beforeprint", () => plots.forEach((plot) => plot.draw()));
    clock.set(0);
  }
  document.addEventListener("DOMContentLoaded", start);
  return { clock, clocked, plots };
})();
