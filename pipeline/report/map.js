(async () => {
  const box = document.getElementById("map-view"), source = document.getElementById("map-data");
  if (!box || !source) return;
  const D = JSON.parse(source.textContent), N = D.rows * D.cols, $ = (name) => box.querySelector(`[data-at="${name}"]`);

  /* -- values: bytes of the pictures, read back by a canvas ------------------------------------------------ */
  const pixels = async (uri) => {
    const picture = new Image();
    picture.src = uri;
    await picture.decode();
    const c = document.createElement("canvas");
    c.width = D.cols; c.height = D.rows;
    const p = c.getContext("2d", { willReadFrequently: true, colorSpace: "srgb" });
    p.drawImage(picture, 0, 0);
    return p.getImageData(0, 0, D.cols, D.rows).data;
  };
  const [A, B, C, photo] = await Promise.all([...D.planes, D.ortho].map(pixels));
  const height = (k) => { const v = A[4 * k] * 256 + A[4 * k + 1]; return v ? D.z[0] + (v - 1) / 65534 * D.z[1] : NaN; };
  const byte = (v, low, span) => v ? low + (v - 1) / 254 * span : NaN;
  const value = {
    elevation: height,
    slope: (k) => byte(C[4 * k + 1], 0, 90),
    sigma: (k) => A[4 * k + 2] ? D.sigma[0] * Math.exp(byte(A[4 * k + 2], 0, D.sigma[1])) : NaN,
    p_hazard: (k) => byte(C[4 * k], 0, 1),
    models: (k) => (B[4 * k] >> 2) || NaN,
    risk: (k) => B[4 * k] & 3,
    reason: (k) => B[4 * k + 1] * 256 + B[4 * k + 2],
  };
  const CLASSES = ["safe", "caution", "hazard", "unknown"];
  const why = (bits) => Object.entries(D.reasons).filter(([, bit]) => bits & bit).map(([name]) => name);
  const metres = (v) => Number.isNaN(v) || v == null ? "–" : Math.abs(v) < 0.1 ? (1000 * v).toFixed(1) + " mm" : v.toFixed(3) + " m";
  const at = (x, y) => {
    const col = Math.round((x - D.x0) / D.cell), row = Math.round((D.y0 - y) / D.cell);
    return col >= 0 && row >= 0 && col < D.cols && row < D.rows ? row * D.cols + col : -1;
  };
  const answer = (x, y) => {
    const k = at(x, y), found = { x, y, cell: k };
    if (k >= 0) for (const name of Object.keys(value)) found[name] = value[name](k);
    return found;
  };

  /* -- colours of the layers ------------------------------------------------------------------------------- */
  const ramp = Uint8Array.from(atob(D.ramp), (c) => c.charCodeAt(0));
  const rgb = (hex) => [1, 3, 5].map((i) => parseInt(hex.slice(i, i + 2), 16));
  const classes = D.colors.map(rgb);
  const range = { slope: [0, 45], p_hazard: [0, 1], elevation: D.shown, models: [0, 1], sigma: [0, 1] };
  for (const name of ["sigma", "models"]) {
    const all = [];
    for (let k = 0; k < N; k += Math.max(1, N >> 14)) { const v = value[name](k); if (v === v) all.push(v); }
    all.sort((a, b) => a - b);
    range[name] = name === "models" ? [1, Math.max(2, all[all.length - 1] || 2)] : [0, all[Math.floor(0.97 * all.length)] || 1];
  }
  /* Grey of the hillshade, computed when it is first asked for. */
  let hills = null;
  const shaded = () => {
    const out = new Uint8ClampedArray(N), step = (a, b) => { const v = height(a) - height(b); return v === v ? v / (2 * D.cell) : 0; };
    for (let row = 0, k = 0; row < D.rows; row++) for (let col = 0; col < D.cols; col++, k++) {
      const gx = step(k + (col + 1 < D.cols), k - (col > 0));
      const gy = step(k - D.cols * (row > 0), k + D.cols * (row + 1 < D.rows));
      out[k] = 255 * Math.max(0, (0.54 * gx - 0.54 * gy + 0.64) / Math.sqrt(gx * gx + gy * gy + 1));
    }
    return out;
  };
  const sheet = document.createElement("canvas");
  sheet.width = D.cols; sheet.height = D.rows;
  const state = { base: "ortho", layer: D.judged ? "risk" : "elevation", opacity: 0.6, by: "plain", ruler: [], measuring: false, three: false };
  const ramped = Array.from({ length: 256 }, (_, i) => ramp.subarray(3 * i, 3 * i + 3));
  /* Okabe and Ito's colours, which also the colour-blind tell apart, and darker ones of them. */
  const KINDS = ["#e69f00", "#56b4e9", "#009e73", "#f0e442", "#0072b2", "#d55e00", "#cc79a7", "#7f5700", "#2b6f99", "#005c43", "#7d3600", "#6e2f57"].map(rgb);
  let first = null;
  const there = () => { /* which reasons are the first one somewhere */
    if (!first) { first = new Set(); const bits = Object.values(D.reasons); for (let k = 0; k < N; k++) { const all = value.reason(k); if (all) first.add(bits.findIndex((bit) => all & bit)); } }
    return first;
  };
  const share = (v, low, high) => ramped[Math.round(255 * Math.min(1, Math.max(0, (v - low) / (high - low))))];
  /* Colour of a cell in the layer chosen; undefined where it has none. */
  const painter = () => {
    const name = state.layer, bits = Object.values(D.reasons);
    if (name === "none") return () => undefined;
    if (name === "risk") return (k) => classes[value.risk(k)];
    if (name === "reason") return (k) => { const all = value.reason(k); return all ? KINDS[bits.findIndex((bit) => all & bit) % KINDS.length] : undefined; };
    const [low, high] = range[name], of = value[name];
    return (k) => { const v = of(k); return v === v ? share(v, low, high) : undefined; };
  };
  const paint = () => {
    const pen = sheet.getContext("2d"), out = pen.createImageData(D.cols, D.rows), o = out.data, ortho = state.base === "ortho", color = painter();
    const empty = state.layer === "risk" ? [...classes[3], 255 * state.opacity] : [0, 0, 0, 0]; /* nothing is known of it */
    if (!ortho && !hills) hills = shaded();
    for (let k = 0, i = 0; k < N; k++, i += 4) {
      if (!(A[i] || A[i + 1])) { for (let j = 0; j < 4; j++) o[i + j] = empty[j]; continue; }
      const c = color(k), mix = c ? state.opacity : 0;
      for (let j = 0; j < 3; j++) o[i + j] = (ortho ? photo[i + j] : hills[k]) * (1 - mix) + (c ? c[j] * mix : 0);
      o[i + 3] = 255;
    }
    pen.putImageData(out, 0, 0);
    legend();
  };
  const gradient = () => "linear-gradient(90deg," + [0, 64, 128, 191, 255].map((i) => `rgb(${ramp[3 * i]},${ramp[3 * i + 1]},${ramp[3 * i + 2]})`) + ")";
  const legend = () => {
    const spot = $("legend"), name = state.layer;
    spot.replaceChildren();
    /* As they look over ground of a middle grey. */
    const seen = (color) => `rgb(${color.map((v) => Math.round(128 + state.opacity * (v - 128)))})`;
    const add = (color, words) => { const li = document.createElement("li"), i = document.createElement("i"); i.style.background = color; li.append(i, words); spot.append(li); };
    const bar = (words) => { add(gradient(), words); spot.lastChild.firstChild.style.width = "6em"; };
    if (name === "risk") classes.forEach((c, i) => add(seen(c), CLASSES[i]));
    else if (name === "reason") Object.keys(D.reasons).forEach((words, n) => { if (there().has(n)) add(seen(KINDS[n % KINDS.length]), words); });
    else if (name !== "none") {
      const [low, high] = range[name], show = { slope: (v) => v + "°", p_hazard: String, models: String }[name] || metres;
      bar(`${name}: ${show(low)} to ${show(high)}`);
    }
    if (name !== "risk") add("#8d8f9833", "no elevation");
    if (D.path.length) { add("#111", "path (disk: its end)"); add("#ffd34d", "vehicle at its start, to scale"); }
    if (Object.keys(D.legs).length) add("#111", "path that was driven by the vehicle's middle (ring: start)");
    if (D.goal) add("#ffd34d", "goal (star)");
    if (state.by === "plain") add("#0b4f8a", "trajectory of the left camera");
    else bar(`trajectory, ${state.by}: 0 to ${metres(most())}`);
  };

  /* -- the map --------------------------------------------------------------------------------------------- */
  const flat = $("flat"), pen = flat.getContext("2d"), view = { x: 0, y: 0, scale: 1 };
  const wide = () => flat.clientWidth, tall = () => flat.clientHeight;
  const fit = () => {
    const xs = [D.x0, D.x0 + D.cell * (D.cols - 1), ...D.track.map((t) => t[1])], ys = [D.y0, D.y0 - D.cell * (D.rows - 1), ...D.track.map((t) => t[2])];
    const [left, right, low, high] = [Math.min(...xs), Math.max(...xs), Math.min(...ys), Math.max(...ys)];
    view.x = (left + right) / 2; view.y = (low + high) / 2;
    view.scale = Math.min(wide() / (right - left + D.cell), tall() / (high - low + D.cell)) * 0.95;
  };
  const screen = (x, y) => [wide() / 2 + (x - view.x) * view.scale, tall() / 2 - (y - view.y) * view.scale];
  const world = (px, py) => [view.x + (px - wide() / 2) / view.scale, view.y - (py - tall() / 2) / view.scale];
  const column = () => state.by === "error" ? 5 : 4;
  const most = () => Math.max(1e-9, ...D.track.map((t) => t[column()] || 0));
  const trackColor = (t) => {
    if (state.by === "plain") return "#0b4f8a";
    const v = t[column()];
    if (v == null) return "#8d8f98";
    const i = 3 * Math.round(255 * Math.min(1, v / most()));
    return `rgb(${ramp[i]},${ramp[i + 1]},${ramp[i + 2]})`;
  };
  const line = (points, color, width) => {
    pen.beginPath();
    points.forEach((p, i) => { const [a, b] = screen(p[0], p[1]); if (i) pen.lineTo(a, b); else pen.moveTo(a, b); });
    pen.strokeStyle = color; pen.lineWidth = width; pen.stroke();
  };
  const round = (v) => { const p = 10 ** Math.floor(Math.log10(v)); return [5, 2, 1].map((s) => s * p).find((s) => s <= v * 1.000001); };
  const columns = [...document.querySelectorAll("[data-frame]")].map((column) => ({ column, frame: +column.dataset.frame }));
  const stops = columns.filter((c) => c.column.parentElement === columns[0].column.parentElement); /* a drive's, or the pairs */
  for (const s of stops) s.at = D.track.find((t) => t[0] === s.frame);
  const go = (i) => {
    state.stop = i;
    const s = stops[i];
    for (const { column, frame } of columns) {
      const film = column.parentElement;
      column.classList.toggle("here", frame === s.frame);
      if (frame === s.frame) film.scrollTo({ left: column.offsetLeft - (film.clientWidth - column.clientWidth) / 2 });
    }
    $("stop").setAttribute("aria-valuetext", `frame ${s.frame}`);
    draw();
    if (s.at) say(s.at[1], s.at[2]);
    $("hover").prepend(`stop ${i + 1} of ${stops.length}, frame ${s.frame}: `);
  };
  const draw = () => {
    const ratio = window.devicePixelRatio || 1;
    if (flat.width !== Math.round(wide() * ratio) || flat.height !== Math.round(tall() * ratio)) { flat.width = Math.round(wide() * ratio); flat.height = Math.round(tall() * ratio); }
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, wide(), tall());
    pen.imageSmoothingEnabled = view.scale * D.cell < 1;
    const [a, b] = screen(D.x0 - D.cell / 2, D.y0 + D.cell / 2);
    pen.drawImage(sheet, a, b, D.cols * D.cell * view.scale, D.rows * D.cell * view.scale);
    pen.lineJoin = pen.lineCap = "round";
    if ($("path").checked && D.path.length) {
      const p = D.path[0], q = D.path.find((v) => Math.hypot(v[0] - p[0], v[1] - p[1]) > D.vehicle[0] / 2) || D.path[D.path.length - 1], turn = Math.atan2(q[1] - p[1], q[0] - p[0]);
      const [u, v] = screen(p[0], p[1]);
      pen.save(); pen.translate(u, v); pen.rotate(-turn);
      const [l, w] = D.vehicle.map((s) => s * view.scale);
      pen.fillStyle = "#ffd34dcc"; pen.strokeStyle = "#111"; pen.lineWidth = 1.5;
      pen.beginPath(); pen.rect(-l / 2, -w / 2, l, w); pen.fill(); pen.stroke(); pen.restore();
    }
    if ($("track").checked && D.track.length) {
      line(D.track.map((t) => t.slice(1)), "#fff", 4);
      D.track.forEach((t, i) => { if (i) line([D.track[i - 1].slice(1), t.slice(1)], trackColor(t), 2.4); });
      for (const t of D.track) { const [u, v] = screen(t[1], t[2]); pen.beginPath(); pen.arc(u, v, 3, 0, 7); pen.fillStyle = trackColor(t); pen.fill(); pen.strokeStyle = "#fff"; pen.lineWidth = 0.8; pen.stroke(); }
    }
    if ($("path").checked && D.path.length) {
      line(D.path, "#fff", 5); line(D.path, "#111", 2.5);
      const [u, v] = screen(...D.path[D.path.length - 1]);
      pen.beginPath(); pen.arc(u, v, 6, 0, 7); pen.fillStyle = "#111"; pen.fill(); pen.strokeStyle = "#fff"; pen.lineWidth = 2; pen.stroke();
    }
    const legs = Object.values(D.legs);
    if (legs.length) { const [u, v] = screen(...legs[0][0]); pen.beginPath(); pen.arc(u, v, 6, 0, 7); pen.strokeStyle = "#111"; pen.lineWidth = 2.5; pen.stroke(); }
    if (D.goal) {
      const [u, v] = screen(...D.goal);
      pen.beginPath();
      for (let i = 0; i < 10; i++) { const r = i % 2 ? 4 : 10, t = Math.PI * (i / 5 - 0.5); pen.lineTo(u + r * Math.cos(t), v + r * Math.sin(t)); }
      pen.closePath(); pen.fillStyle = "#ffd34d"; pen.strokeStyle = "#111"; pen.lineWidth = 1.5; pen.fill(); pen.stroke();
    }
    const stop = stops[state.stop];
    for (const [frame, leg] of Object.entries(D.legs)) if (!stop || +frame <= stop.frame) { const here = stop && +frame === stop.frame; line(leg, "#fff", here ? 6 : 3); line(leg, here ? "#c0167a" : "#111", here ? 3.5 : 1.5); }
    if (stop && stop.at) {
      const [u, v] = screen(stop.at[1], stop.at[2]);
      pen.beginPath(); pen.arc(u, v, 8, 0, 7); pen.strokeStyle = "#fff"; pen.lineWidth = 5; pen.stroke(); pen.strokeStyle = "#c0167a"; pen.lineWidth = 3; pen.stroke();
    }
    if (state.ruler.length) line(state.ruler, "#c0167a", 2.5);
    const long = round(0.25 * wide() / view.scale), words = long < 1 ? 100 * long + " cm" : long + " m";
    pen.fillStyle = "#fffffff0"; pen.fillRect(8, tall() - 34, long * view.scale + 12, 28);
    pen.fillStyle = "#111"; pen.fillRect(14, tall() - 14, long * view.scale, 3); pen.font = "12px system-ui, sans-serif"; pen.fillText(words, 14, tall() - 18);
  };
  const say = (x, y) => {
    const f = answer(x, y);
    const words = [`x ${x.toFixed(3)} m`, `y ${y.toFixed(3)} m`];
    if (f.cell < 0 || Number.isNaN(f.elevation)) words.push("unknown ground");
    else {
      words.push(`z ${f.elevation.toFixed(3)} m`, `σ ${metres(f.sigma)}`, `slope ${f.slope.toFixed(1)}°`);
      if (D.judged) words.push(CLASSES[f.risk] + (f.reason ? ` (${why(f.reason).join(", ")})` : ""));
    }
    if (state.ruler.length === 2) words.push(`ruler ${metres(Math.hypot(state.ruler[1][0] - state.ruler[0][0], state.ruler[1][1] - state.ruler[0][1]))}`);
    $("hover").textContent = words.join(" · ");
  };
  const zoom = (factor, px = wide() / 2, py = tall() / 2) => {
    const [x, y] = world(px, py);
    view.scale *= factor;
    view.x = x - (px - wide() / 2) / view.scale; view.y = y + (py - tall() / 2) / view.scale;
    draw();
  };
  const fingers = new Map();
  const place = (e) => { const r = flat.getBoundingClientRect(); return [e.clientX - r.left, e.clientY - r.top]; };
  flat.addEventListener("pointerdown", (e) => {
    flat.setPointerCapture(e.pointerId); fingers.set(e.pointerId, place(e));
    if (state.measuring) state.ruler = [world(...place(e))];
  });
  flat.addEventListener("pointermove", (e) => {
    const now = place(e), before = fingers.get(e.pointerId);
    if (before) {
      if (state.measuring) state.ruler[1] = world(...now);
      else if (fingers.size === 1) { view.x -= (now[0] - before[0]) / view.scale; view.y += (now[1] - before[1]) / view.scale; }
      else {
        const other = [...fingers].find(([id]) => id !== e.pointerId)[1], gap = (p) => Math.hypot(p[0] - other[0], p[1] - other[1]);
        zoom(gap(now) / Math.max(1, gap(before)), (now[0] + other[0]) / 2, (now[1] + other[1]) / 2);
      }
      fingers.set(e.pointerId, now);
      draw();
    }
    say(...world(...now));
  });
  for (const name of ["pointerup", "pointercancel"]) flat.addEventListener(name, (e) => fingers.delete(e.pointerId));
  flat.addEventListener("wheel", (e) => { e.preventDefault(); zoom(Math.exp(-0.0015 * e.deltaY), ...place(e)); }, { passive: false });
  flat.addEventListener("keydown", (e) => {
    const move = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[e.key];
    if (move) { view.x += 30 * move[0] / view.scale; view.y += 30 * move[1] / view.scale; draw(); }
    else if (e.key === "+" || e.key === "=") zoom(1.3);
    else if (e.key === "-") zoom(1 / 1.3);
    else if (e.key === "0") { fit(); draw(); }
    else return;
    e.preventDefault();
    say(view.x, view.y);
  });

  /* -- controls --------------------------------------------------------------------------------------------- */
  let space = null;
  const eye = { turn: -0.6, tilt: 0.75, far: 0.7, tall: 1 };
  const profile = () => drawProfile($("profile"), D, metres, round);
  const refresh = () => {
    paint();
    if (state.three && space) { space.texture(); space.render(); } else draw();
  };
  $("base").addEventListener("change", (e) => { state.base = e.target.value; refresh(); });
  $("layer").value = state.layer;
  $("layer").addEventListener("change", (e) => { state.layer = e.target.value; refresh(); });
  $("opacity").addEventListener("input", (e) => { state.opacity = e.target.value / 100; refresh(); });
  $("by").addEventListener("change", (e) => { state.by = e.target.value; legend(); draw(); });
  for (const name of ["track", "path"]) $(name).addEventListener("change", draw);
  if (stops.length > 1) {
    $("stops").hidden = false;
    $("stop").max = stops.length - 1;
    $("stop").addEventListener("input", (e) => go(+e.target.value));
  }
  $("in").addEventListener("click", () => zoom(1.4));
  $("out").addEventListener("click", () => zoom(1 / 1.4));
  $("fit").addEventListener("click", () => { fit(); draw(); });
  $("ruler").addEventListener("click", (e) => { state.measuring = !state.measuring; if (!state.measuring) state.ruler = []; e.target.setAttribute("aria-pressed", state.measuring); draw(); });
  $("tall").addEventListener("input", (e) => { eye.tall = +e.target.value; $("times").textContent = eye.tall.toFixed(1); if (space) space.render(); });
  $("three").addEventListener("click", (e) => {
    state.three = !state.three;
    flat.hidden = state.three; $("space").hidden = !state.three;
    if (state.three && !space) space = openSpace($("space"), D, { at, height, sheet, eye });
    if (state.three && !space) {
      $("hover").textContent = "This browser has no WebGL2: the map stays flat.";
      state.three = false; flat.hidden = false; $("space").hidden = true;
    }
    e.target.setAttribute("aria-pressed", state.three);
    for (const name of ["in", "out", "fit", "ruler"]) $(name).disabled = state.three;
    refresh();
  });
  document.getElementById("map-still").hidden = true;
  box.hidden = false;
  if (!D.track.some((t) => t[5] != null)) $("by").querySelector('[value="error"]').remove();
  if (!D.path.length) $("profile").hidden = true;
  fit(); paint(); draw(); profile();
  addEventListener("resize", () => { if (state.three && space) space.render(); else draw(); profile(); });
  box.answer = answer;
  box.dataset.ready = "1";
  performance.mark("map");
})();
