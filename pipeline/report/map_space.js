/* The terrain in space, on a canvas that the user turns; null without WebGL2. D are the data of the map, at and height
   find a cell and its height, sheet is the picture that lies on the ground, and eye is where it is seen from. */
const openSpace = (c, D, { at, height, sheet, eye }) => {
  const gl = c.getContext("webgl2", { antialias: true, preserveDrawingBuffer: true });
  if (!gl) return null;
  const make = (vertex, fragment) => {
    const program = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const s = gl.createShader(kind);
      gl.shaderSource(s, "#version 300 es\nprecision highp float;\n" + text); gl.compileShader(s);
      if (!gl.getShaderParameter(s, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(s));
      gl.attachShader(program, s);
    }
    gl.linkProgram(program);
    return program;
  };
  const ground = make(
    "in vec3 p; in vec2 t; uniform mat4 m; uniform float e; out vec2 uv; out float z; void main(){ uv=t; z=p.z; gl_Position=m*vec4(p.xy,p.z*e,1.); }",
    "in vec2 uv; in float z; uniform sampler2D s; out vec4 c; void main(){ c=vec4(texture(s,uv).rgb,1.); }");
  const strokes = make(
    "in vec3 p; uniform mat4 m; uniform float e; void main(){ gl_Position=m*vec4(p.xy,p.z*e,1.); gl_Position.z-=.002*gl_Position.w; }",
    "uniform vec3 k; out vec4 c; void main(){ c=vec4(k,1.); }");
  const skip = Math.max(1, Math.ceil(Math.max(D.rows, D.cols) / 400)), R = Math.floor((D.rows - 1) / skip) + 1, Q = Math.floor((D.cols - 1) / skip) + 1;
  const size = Math.max(D.rows, D.cols) * D.cell, cx = D.x0 + D.cell * (D.cols - 1) / 2, cy = D.y0 - D.cell * (D.rows - 1) / 2, cz = (D.shown[0] + D.shown[1]) / 2;
  const local = (q) => [(q[0] - cx) / size * 2, (q[1] - cy) / size * 2, (q[2] - cz) / size * 2];
  const vertices = [], faces = [], known = [];
  for (let i = 0; i < R; i++) for (let j = 0; j < Q; j++) {
    const row = i * skip, col = j * skip, z = height(row * D.cols + col);
    known.push(z === z);
    vertices.push(...local([D.x0 + col * D.cell, D.y0 - row * D.cell, z === z ? z : cz]), (col + 0.5) / D.cols, (row + 0.5) / D.rows);
  }
  for (let i = 0; i + 1 < R; i++) for (let j = 0; j + 1 < Q; j++) {
    const a = i * Q + j, b = a + 1, d = a + Q, f = d + 1;
    if (known[a] && known[b] && known[d]) faces.push(a, d, b);
    if (known[b] && known[d] && known[f]) faces.push(b, d, f);
  }
  const buffer = (kind, data) => { const b = gl.createBuffer(); gl.bindBuffer(kind, b); gl.bufferData(kind, data, gl.STATIC_DRAW); return b; };
  const V = buffer(gl.ARRAY_BUFFER, new Float32Array(vertices)), F = buffer(gl.ELEMENT_ARRAY_BUFFER, new Uint32Array(faces)), T = gl.createTexture();
  const strip = (points, color, kind) => ({ b: buffer(gl.ARRAY_BUFFER, new Float32Array(points.flatMap(local))), n: points.length, color, kind });
  const lift = (q) => [q[0], q[1], q[2] + 0.002 * size];
  const lines = [strip(D.path.map(lift), [0.07, 0.07, 0.07], gl.LINE_STRIP), strip(D.track.map((t) => t.slice(1, 4)), [0.04, 0.31, 0.54], gl.LINE_STRIP)];
  const onGround = (q) => { const k = at(q[0], q[1]), z = k < 0 ? NaN : height(k); return [q[0], q[1], z === z ? z : cz]; };
  for (const leg of Object.values(D.legs)) lines.push(strip(leg.map(onGround).map(lift), [0.07, 0.07, 0.07], gl.LINE_STRIP));
  const texture = () => { gl.bindTexture(gl.TEXTURE_2D, T); gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, sheet); gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR); gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE); gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE); };
  const render = () => {
    const ratio = window.devicePixelRatio || 1;
    c.width = c.clientWidth * ratio; c.height = c.clientHeight * ratio;
    gl.viewport(0, 0, c.width, c.height);
    gl.clearColor(0, 0, 0, 0); gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT); gl.enable(gl.DEPTH_TEST);
    /* rows of world turned about z, tilted, moved away, then perspective */
    const [ct, st, cp, sp] = [Math.cos(eye.turn), Math.sin(eye.turn), Math.cos(eye.tilt), Math.sin(eye.tilt)], g = 1.8 * Math.min(1, c.width / c.height), aspect = c.width / c.height, d = 2.6 * eye.far;
    const right = [ct, st, 0], up = [-st * sp, ct * sp, cp], back = [st * cp, -ct * cp, sp], near = 0.02, distant = 20;
    const k = -(distant + near) / (distant - near), q = -2 * distant * near / (distant - near), m = [];
    for (let i = 0; i < 3; i++) m.push(g / aspect * right[i], g * up[i], k * back[i], -back[i]);
    m.push(0, 0, -k * d + q, d);
    const set = (program) => { gl.useProgram(program); gl.uniformMatrix4fv(gl.getUniformLocation(program, "m"), false, m); gl.uniform1f(gl.getUniformLocation(program, "e"), eye.tall); };
    const attribute = (program, name, n, stride, offset) => { const a = gl.getAttribLocation(program, name); gl.enableVertexAttribArray(a); gl.vertexAttribPointer(a, n, gl.FLOAT, false, stride, offset); };
    set(ground); gl.bindBuffer(gl.ARRAY_BUFFER, V); attribute(ground, "p", 3, 20, 0); attribute(ground, "t", 2, 20, 12);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, F); gl.drawElements(gl.TRIANGLES, faces.length, gl.UNSIGNED_INT, 0);
    gl.disableVertexAttribArray(1); gl.disableVertexAttribArray(0);
    set(strokes);
    for (const l of lines) { if (!l.n) continue; gl.bindBuffer(gl.ARRAY_BUFFER, l.b); attribute(strokes, "p", 3, 0, 0); gl.uniform3fv(gl.getUniformLocation(strokes, "k"), l.color); gl.drawArrays(l.kind, 0, l.n); }
  };
  let held = null;
  c.addEventListener("pointerdown", (e) => { c.setPointerCapture(e.pointerId); held = [e.clientX, e.clientY]; });
  c.addEventListener("pointermove", (e) => { if (!held) return; eye.turn -= 0.008 * (e.clientX - held[0]); eye.tilt = Math.min(1.57, Math.max(0.05, eye.tilt + 0.008 * (e.clientY - held[1]))); held = [e.clientX, e.clientY]; render(); });
  for (const name of ["pointerup", "pointercancel"]) c.addEventListener(name, () => { held = null; });
  c.addEventListener("wheel", (e) => { e.preventDefault(); eye.far = Math.min(4, Math.max(0.1, eye.far * Math.exp(0.0012 * e.deltaY))); render(); }, { passive: false });
  c.addEventListener("keydown", (e) => {
    const turn = { ArrowLeft: [0.1, 0], ArrowRight: [-0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] }[e.key];
    if (turn) { eye.turn += turn[0]; eye.tilt = Math.min(1.57, Math.max(0.05, eye.tilt + turn[1])); }
    else if (e.key === "+" || e.key === "=") eye.far /= 1.2;
    else if (e.key === "-") eye.far *= 1.2;
    else return;
    e.preventDefault(); render();
  });
  return { render, texture };
};
