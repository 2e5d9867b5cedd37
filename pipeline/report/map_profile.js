/* Height and slope along the path, drawn on a canvas; D are the data of the map. */
const drawProfile = (c, D, metres, round) => {
  if (!c || D.path.length < 2) return;
  const ratio = window.devicePixelRatio || 1, w = c.clientWidth, h = c.clientHeight, p = c.getContext("2d");
  c.width = w * ratio; c.height = h * ratio; p.scale(ratio, ratio);
  const s = [0];
  for (let i = 1; i < D.path.length; i++) s.push(s[i - 1] + Math.hypot(D.path[i][0] - D.path[i - 1][0], D.path[i][1] - D.path[i - 1][1]));
  const zs = D.path.map((q) => q[2]), low = Math.min(...zs), high = Math.max(...zs), top = Math.max(high - low, 1e-6);
  const slopes = D.path.map((q) => q[3] ?? NaN); /* as the planner judged them: over the vehicle's reach, not a cell */
  const X = (i) => 44 + (w - 88) * s[i] / s[s.length - 1], ink = getComputedStyle(c).color;
  /* Height above, inclination below: in one frame the height would seem to cross the limit. */
  const half = (h - 34) / 2, low_ = 14 + half, foot = h - 20;
  const curve = (y, color) => { p.beginPath(); let pen_ = false; zs.forEach((_, i) => { const v = y(i); if (v !== v) { pen_ = false; return; } if (pen_) p.lineTo(X(i), v); else p.moveTo(X(i), v); pen_ = true; }); p.strokeStyle = color; p.lineWidth = 1.8; p.stroke(); };
  const steep = Math.max(D.limit, ...slopes.filter((v) => v === v)) * 1.1, Y = (v) => foot - (half - 6) * v / steep;
  p.setLineDash([4, 4]); p.beginPath(); p.moveTo(44, Y(D.limit)); p.lineTo(w - 44, Y(D.limit)); p.strokeStyle = "#c0392b"; p.stroke(); p.setLineDash([]);
  curve((i) => Y(slopes[i]), "#d1731a");
  curve((i) => low_ - 4 - (half - 8) * (zs[i] - low) / top, "#4a90c8");
  p.strokeStyle = "#8888"; p.lineWidth = 1;
  const far = s[s.length - 1], tick = round(far / 5);
  for (let d = 0; d <= far; d += tick) { const x = 44 + (w - 88) * d / far; p.beginPath(); p.moveTo(x, 10); p.lineTo(x, foot); p.stroke(); }
  p.font = "11px system-ui, sans-serif"; p.fillStyle = ink;
  p.fillText(metres(high), 0, 20, 42); p.fillText(metres(low), 0, low_, 42); /* at most so wide */ p.fillText(D.limit + "°", w - 40, Y(D.limit) + 4); p.fillText("0°", w - 40, foot);
  p.fillText(`height (blue) and inclination (orange; dashed: limit) along the path of ${metres(far)}, lines every ${tick < 1 ? 100 * tick + " cm" : tick + " m"}`, 0, h - 4, w);
};
