// The wall under a tool, for the page and for play.html; it is handed THREE and loads nothing.
//
// unpack(buffer): a packet as {text keys ..., arrays}. mount(...): the view of a scene.
const MAPS = {
  viridis: [[68, 1, 84], [71, 45, 123], [59, 82, 139], [44, 114, 142], [33, 145, 140], [40, 174, 128],
    [94, 201, 98], [173, 220, 48], [253, 231, 37]],
  cividis: [[0, 34, 78], [26, 56, 111], [67, 78, 108], [97, 101, 111], [125, 124, 120], [155, 148, 118],
    [188, 174, 108], [222, 201, 88], [254, 232, 56]],
};
const KINDS = { float32: Float32Array, uint32: Uint32Array, uint8: Uint8Array, int16: Int16Array };
const COLOURS = { displacement: "displacement [mm]", depth: "inward motion [mm]" };
const PLANES = { free: "free", z: "x-y plane", y: "x-z plane", x: "y-z plane" };
const STEP = 0.5, TURN = Math.PI / 36, FAR = 1000;

export function unpack(buffer) {
  const size = new Uint32Array(buffer, 0, 1)[0];
  const text = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, size)));
  const arrays = {};
  for (const [name, kind, start, count] of text.arrays)
    arrays[name] = new KINDS[kind](buffer, 4 + size + start, count);
  return { ...text, arrays };
}

function linear(c) { // sRGB of a screen to the light that the GPU adds up
  c /= 255;
  return c <= 0.04045 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4;
}

function colourMap(name) { // 256 colours, linear
  const stops = MAPS[name], out = new Float32Array(768);
  for (let i = 0; i < 256; i++) {
    const x = (i / 255) * 8, k = Math.min(Math.floor(x), 7), f = x - k;
    for (let j = 0; j < 3; j++) out[3 * i + j] = linear(stops[k][j] + f * (stops[k + 1][j] - stops[k][j]));
  }
  return out;
}

function make(kind, parent, style = {}, text = "") {
  const e = document.createElement(kind);
  Object.assign(e.style, style);
  e.textContent = text;
  parent.appendChild(e);
  return e;
}

function makeTool(T, world, { arrays, colours }, k) { // its picture, its force, and what it is printed with
  const corners = arrays[`tool${k}`], sides = arrays[`sides${k}`], shape = new T.BufferGeometry();
  shape.setAttribute("position", new T.BufferAttribute(corners, 3));
  shape.setIndex(new T.BufferAttribute(sides, 1)); shape.computeVertexNormals();
  const mesh = new T.Mesh(shape, new T.MeshStandardMaterial({ color: colours[k % colours.length], transparent: true,
    opacity: 0.45, depthWrite: false }));
  mesh.visible = corners.length > 0;
  const arrow = new T.ArrowHelper(new T.Vector3(0, 1, 0), new T.Vector3(), 10, "#c0102a", 3, 2);
  arrow.visible = false;
  world.add(mesh, arrow);
  // Faces as half-spaces: a vertex of the wall at rest within all of them is printed on.
  const spaces = [], p = (i) => new T.Vector3().fromArray(corners, 3 * i);
  for (let f = 0; f < sides.length; f += 3) {
    const a = p(sides[f]), w = p(sides[f + 1]).sub(a).cross(p(sides[f + 2]).sub(a));
    if (w.length() > 1e-12) { w.normalize(); spaces.push(w.x, w.y, w.z, w.dot(a)); }
  }
  let widest = 0;
  for (let i = 0; i < corners.length; i += 3)
    widest = Math.max(widest, Math.hypot(corners[i], corners[i + 1], corners[i + 2]));
  return { mesh, arrow, corners, spaces, widest };
}

export function mount(T, Orbit, el, scene, { onPose = () => {}, movable = true } = {}) {
  const { rest, faces, ring, joints } = scene.arrays, n = rest.length / 3, several = scene.tools.length > 1;
  const option = { tool: 0, colour: "displacement", map: "viridis", plane: "free", rings: true, joints: true,
    print: true, rest: true, hold: false };
  el.style.position = "relative"; el.style.overflow = "hidden"; el.tabIndex = 0; el.style.outline = "none";

  // The picture.
  const world = new T.Scene(); world.background = new T.Color("#f6f6f4");
  const camera = new T.PerspectiveCamera(30, 1, 1, 4000);
  const renderer = new T.WebGLRenderer({ antialias: true, preserveDrawingBuffer: true });
  el.appendChild(renderer.domElement);
  renderer.domElement.style.display = "block";
  world.add(new T.HemisphereLight("#ffffff", "#8a8a96", 2.2));
  const sun = new T.DirectionalLight("#ffffff", 1.6); sun.position.set(40, 120, 90); world.add(sun);
  const wall = new T.BufferGeometry();
  const surface = new T.BufferAttribute(new Float32Array(rest), 3).setUsage(T.DynamicDrawUsage);
  const rgb = new T.BufferAttribute(new Float32Array(3 * n), 3).setUsage(T.DynamicDrawUsage);
  wall.setAttribute("position", surface); wall.setAttribute("color", rgb);
  wall.setIndex(new T.BufferAttribute(faces, 1));
  wall.computeVertexNormals();
  const outward = new Float32Array(wall.getAttribute("normal").array); // at rest
  wall.deleteAttribute("normal");
  wall.computeBoundingSphere();
  const middle = wall.boundingSphere.center.clone(), size = wall.boundingSphere.radius;
  wall.boundingSphere.radius *= 3; // the wall moves; picking looks here first
  const skin = new T.MeshStandardMaterial({ vertexColors: true, flatShading: true, roughness: 0.7,
    side: T.DoubleSide });
  const mesh = new T.Mesh(wall, skin);
  const ghostShape = new T.BufferGeometry();
  ghostShape.setAttribute("position", new T.BufferAttribute(rest, 3)); ghostShape.setIndex(wall.index);
  const ghost = new T.Mesh(ghostShape, new T.MeshBasicMaterial({ color: "#7788aa", wireframe: true,
    transparent: true, opacity: 0.08, depthWrite: false }));
  const dots = new T.InstancedMesh(new T.SphereGeometry(0.9, 10, 8),
    new T.MeshStandardMaterial({ color: "#1d3557" }), joints.length);
  dots.frustumCulled = false;
  world.add(mesh, ghost, dots);
  const tools = scene.tools.map((_, k) => makeTool(T, world, scene, k));
  let tool = tools[0].mesh, corners = tools[0].corners; // those in hand
  const orbit = new Orbit(camera, renderer.domElement);
  let dirty = true;
  orbit.addEventListener("change", () => { dirty = true; });

  // Words over the picture.
  const over = { position: "absolute", pointerEvents: "none", font: "14px sans-serif", color: "#1b1b1f" };
  const head = make("div", el, { ...over, left: "12px", top: "8px" });
  const number = make("div", head, { fontSize: "24px", fontWeight: "600" }, "…");
  number.dataset.role = "force";
  const second = make("div", head, {}, ""); second.dataset.role = "detail";
  const third = make("div", head, { fontSize: "12px" }, ""); third.dataset.role = "place";
  const others = make("div", head, { whiteSpace: "pre" }); others.dataset.role = "others";
  const legend = make("div", el, { ...over, left: "8px", bottom: "8px", width: "220px", boxSizing: "content-box", padding: "6px",
    background: "rgba(255,255,255,.8)", borderRadius: "4px", fontSize: "12px" });
  const bar = make("canvas", legend, { width: "220px", height: "12px", display: "block" });
  bar.width = 256; bar.height = 1;
  const scale = make("div", legend, { display: "flex", justifyContent: "space-between" });
  make("span", scale, {}, "0");
  const what = make("span", scale), high = make("span", scale);
  const names = [["carina", -1], ["larynx", 1]].map(([text, side]) =>
    [make("div", el, { ...over, fontSize: "12px",
      background: "rgba(255,255,255,.8)", padding: "1px 4px", borderRadius: "3px" }, text), side]);
  const panel = make("div", el, { position: "absolute", right: "8px", top: "8px", display: "flex",
    flexDirection: "column", gap: "3px", font: "12px sans-serif", background: "rgba(255,255,255,.8)",
    padding: "6px", borderRadius: "4px" });

  function choice(label, key, values) {
    const row = make("label", panel, { display: "flex", gap: "6px", justifyContent: "space-between" }, label);
    const box = make("select", row); box.dataset.option = key;
    for (const [value, text] of Object.entries(values)) make("option", box, {}, text).value = value;
    box.onchange = () => set(key, box.value);
  }
  function tick(label, key) {
    const row = make("label", panel, { display: "flex", gap: "6px" });
    const box = make("input", row); box.type = "checkbox"; box.checked = option[key]; box.dataset.option = key;
    row.append(label);
    box.onchange = () => set(key, box.checked);
  }
  choice("colour", "colour", COLOURS);
  choice("scale", "map", { viridis: "viridis", cividis: "cividis" });
  if (several) choice("tool", "tool", { ...scene.tools });
  if (movable) { choice("drag", "plane", PLANES); tick("hold the tool", "hold"); }
  for (const [label, key] of [["rings", "rings"], ["ring midpoints", "joints"], ["print of the tool", "print"],
    ["rest shape", "rest"]]) tick(label, key);
  const buttons = make("div", panel, { display: "flex", gap: "4px" });
  const button = (text, act) => { make("button", buttons, {}, text).onclick = act; };
  button("PNG", png); button("film", film);

  // What is shown now.
  let colours = colourMap(option.map), last = null, top = 1e-3, filming = null;
  const values = new Float32Array(n), stats = { frames: 0, drawn: 0, bytes: 0 };

  function set(key, value) {
    option[key] = value;
    if (key === "tool") take(+value);
    if (key === "map") colours = colourMap(value);
    dots.visible = option.joints; ghost.visible = option.rest;
    paint();
  }

  function take(k) { // into the hand
    option.tool = k; tool = tools[k].mesh; corners = tools[k].corners;
    const box = panel.querySelector("[data-option=tool]");
    if (box) box.value = k;
    tell(); dirty = true; onPose(k, pose());
  }

  function paint() {
    const v = surface.array, depth = option.colour === "depth";
    top = 1e-3;
    for (let i = 0; i < n; i++) {
      const a = v[3 * i] - rest[3 * i], b = v[3 * i + 1] - rest[3 * i + 1], c = v[3 * i + 2] - rest[3 * i + 2];
      values[i] = depth ? Math.max(0, -(a * outward[3 * i] + b * outward[3 * i + 1] + c * outward[3 * i + 2]))
        : Math.hypot(a, b, c);
      if (values[i] > top) top = values[i];
    }
    const stale = last !== null && !last.solved;
    const inside = option.print ? printed() : null;
    for (let i = 0; i < n; i++) {
      const k = 3 * Math.round(255 * Math.min(values[i] / top, 1));
      const light = option.rings && ring[i] ? 0.12 : 0, dim = inside && inside[i] ? 0.3 : 1;
      for (let j = 0; j < 3; j++)
        rgb.array[3 * i + j] = (light + (1 - light) * (stale ? 0.3 : colours[k + j])) * dim;
    }
    rgb.needsUpdate = true;
    const m = new T.Matrix4();
    joints.forEach((i, k) => dots.setMatrixAt(k, m.makeTranslation(v[3 * i], v[3 * i + 1], v[3 * i + 2])));
    dots.instanceMatrix.needsUpdate = true;
    const c = bar.getContext("2d"), row = c.createImageData(256, 1), stops = MAPS[option.map];
    for (let i = 0; i < 256; i++) {
      const x = (i / 255) * 8, k = Math.min(Math.floor(x), 7);
      for (let j = 0; j < 3; j++) row.data[4 * i + j] = stops[k][j] + (x - k) * (stops[k + 1][j] - stops[k][j]);
      row.data[4 * i + 3] = 255;
    }
    c.putImageData(row, 0, 0);
    what.textContent = COLOURS[option.colour]; high.textContent = top > 1e-3 ? top.toPrecision(3) : "0.001";
    dirty = true;
  }

  function printed() {
    const out = new Uint8Array(n), x = new T.Vector3();
    for (const { mesh: { visible, position: p, matrixWorld }, spaces, widest } of tools) {
      if (!visible) continue;
      const back = new T.Matrix4().copy(matrixWorld).invert();
      for (let i = 0; i < n; i++) {
        if (Math.hypot(rest[3 * i] - p.x, rest[3 * i + 1] - p.y, rest[3 * i + 2] - p.z) > widest) continue;
        x.fromArray(rest, 3 * i).applyMatrix4(back);
        let k = 0;
        while (k < spaces.length && spaces[k] * x.x + spaces[k + 1] * x.y + spaces[k + 2] * x.z <= spaces[k + 3]) k += 4;
        out[i] |= k >= spaces.length ? 1 : 0;
      }
    }
    return out;
  }

  function posed(all) { // of each tool the rotation by rows, then the translation
    tools.forEach(({ mesh }, k) => {
      const q = all.slice(12 * k, 12 * k + 12);
      const r = new T.Matrix4().set(q[0], q[1], q[2], 0, q[3], q[4], q[5], 0, q[6], q[7], q[8], 0, 0, 0, 0, 1);
      mesh.quaternion.setFromRotationMatrix(r); mesh.position.set(q[9], q[10], q[11]);
      mesh.updateMatrixWorld(true);
    });
    dirty = true;
  }
  function pose() {
    const q = tool.quaternion.clone().normalize(), e = new T.Matrix4().makeRotationFromQuaternion(q).elements;
    return [e[0], e[4], e[8], e[1], e[5], e[9], e[2], e[6], e[10], ...tool.position.toArray()];
  }

  // A frame: vertices, ms, of each tool eight numbers (status, force, depth, point); positions.
  function show(h, positions) {
    const solved = positions !== null;
    if (solved) { surface.array.set(positions); surface.needsUpdate = true; }
    const touches = tools.map(({ arrow }, k) => {
      const [status, x, y, z, depth, ...point] = h.subarray(2 + 8 * k, 10 + 8 * k);
      const [name, message, forced] = scene.statuses[status], f = Math.hypot(x, y, z), has = solved && forced;
      arrow.visible = has && f > 1e-6;
      if (arrow.visible) {
        const way = new T.Vector3(x, y, z).normalize(), long = 8 + 20 * Math.min(f, 2);
        arrow.setDirection(way); arrow.setLength(long, 3, 2);
        arrow.position.fromArray(point).addScaledVector(way, -long);
      }
      const words = !solved || (has && name !== "OK") ? message
        : has ? `depth ${depth.toFixed(3)} mm` : "the tool does not touch";
      return { status: name, solved, force: has ? f : null, depth: solved ? depth : null, words,
        label: has ? `F ${f.toFixed(4)} N` : name === "NO_CONTACT" ? "no contact" : "no force" };
    });
    last = { ...touches[option.tool], solved, touches };
    stats.frames++;
    tell(); paint();
    return last;
  }
  function tell() { // the words over the picture: of the tool in hand, then of the others
    if (last === null) return;
    const own = last.touches[option.tool];
    number.textContent = own.label; second.textContent = own.words + (last.solved ? "" : " (grey: the last surface)");
    const named = several ? scene.tools[option.tool] : "tool";
    third.textContent = tool.visible ? `${named} at ${tool.position.toArray().map((v) => v.toFixed(2)).join(", ")} mm` : named;
    others.textContent = last.touches.map((t, k) => `${scene.tools[k]}: ${t.label}`).filter((_, k) => k !== option.tool).join("\n");
  }
  function frame(buffer) {
    stats.bytes = buffer.byteLength;
    const size = 2 + 8 * tools.length, h = new Float32Array(buffer, 0, size);
    return show(h, h[0] > 0 ? new Float32Array(buffer, 4 * size) : null);
  }

  // The hand.
  function moved() {
    tool.position.clampScalar(-FAR, FAR); tool.updateMatrixWorld(true); dirty = true; onPose(option.tool, pose());
  }
  const ray = new T.Raycaster(), plane = new T.Plane(), hit = new T.Vector3(), grip = new T.Vector3();
  let dragging = false, down = null;
  function aim(e) {
    const b = renderer.domElement.getBoundingClientRect();
    ray.setFromCamera(new T.Vector2(((e.clientX - b.left) / b.width) * 2 - 1,
      1 - ((e.clientY - b.top) / b.height) * 2), camera);
  }
  const ways = { x: new T.Vector3(1, 0, 0), y: new T.Vector3(0, 1, 0), z: new T.Vector3(0, 0, 1) };
  renderer.domElement.addEventListener("pointerdown", (e) => {
    el.focus(); aim(e); down = [e.clientX, e.clientY];
    const on = movable && !option.hold && ray.intersectObjects(tools.map((t) => t.mesh))[0];
    if (!on) return;
    take(tools.findIndex((t) => t.mesh === on.object));
    dragging = true; orbit.enabled = false; renderer.domElement.setPointerCapture(e.pointerId);
    plane.setFromNormalAndCoplanarPoint(ways[option.plane] ?? camera.getWorldDirection(new T.Vector3()), on.point);
    grip.copy(tool.position).sub(on.point);
  }, true);
  renderer.domElement.addEventListener("pointermove", (e) => {
    if (!dragging) return;
    aim(e);
    if (ray.ray.intersectPlane(plane, hit) && hit.distanceTo(middle) < 4 * size) {
      tool.position.copy(hit).add(grip); moved();
    }
  });
  renderer.domElement.addEventListener("pointerup", (e) => {
    const still = down && Math.hypot(e.clientX - down[0], e.clientY - down[1]) < 3;
    if (!dragging && still && movable && !option.hold && e.button === 0) press(e);
    dragging = false; orbit.enabled = true;
  });
  function press(e) { // a click on the wall: the tool presses there, 1 mm deep
    aim(e);
    const on = ray.intersectObject(mesh)[0];
    if (!on) return;
    const way = new T.Vector3();
    for (const i of [on.face.a, on.face.b, on.face.c]) way.add(new T.Vector3().fromArray(outward, 3 * i));
    way.normalize();
    const at = new T.Vector3();
    for (const i of [on.face.a, on.face.b, on.face.c]) at.add(new T.Vector3().fromArray(rest, 3 * i));
    at.divideScalar(3);
    const own = way.clone().negate().applyQuaternion(tool.quaternion.clone().invert());
    let far = -Infinity;
    for (let i = 0; i < corners.length; i += 3)
      far = Math.max(far, corners[i] * own.x + corners[i + 1] * own.y + corners[i + 2] * own.z);
    tool.position.copy(at).addScaledVector(way, far - 1);
    moved();
  }
  const shifts = { ArrowRight: [0, 1], ArrowLeft: [0, -1], ArrowUp: [1, 1], ArrowDown: [1, -1],
    PageUp: [2, 1], PageDown: [2, -1] };
  const turns = { KeyE: ["x", 1], KeyQ: ["x", -1], KeyD: ["y", 1], KeyA: ["y", -1], KeyW: ["z", 1], KeyS: ["z", -1] };
  function key(e) {
    if (!movable || option.hold || e.ctrlKey || e.metaKey || e.altKey) return;
    if (e.target.matches?.("input, select, textarea")) return;
    const less = e.shiftKey ? 0.1 : 1, digit = /^Digit([1-9])$/.exec(e.code);
    if (several && digit && tools[digit[1] - 1]) { take(digit[1] - 1); return; }
    if (shifts[e.code]) {
      const [axis, sign] = shifts[e.code];
      tool.position.setComponent(axis, tool.position.getComponent(axis) + sign * less * STEP);
    } else if (turns[e.code]) {
      const [axis, sign] = turns[e.code];
      tool.quaternion.premultiply(new T.Quaternion().setFromAxisAngle(ways[axis], sign * less * TURN));
    } else return;
    e.preventDefault(); moved();
  }
  addEventListener("keydown", key);

  // Pictures and films hold the words, too.
  function compose(canvas) {
    const gl = renderer.domElement, c = canvas.getContext("2d"), k = gl.width / gl.clientWidth;
    canvas.width = gl.width; canvas.height = gl.height;
    renderer.render(world, camera);
    c.drawImage(gl, 0, 0); c.scale(k, k); c.fillStyle = "#1b1b1f";
    c.font = "600 24px sans-serif"; c.fillText(number.textContent, 12, 32);
    c.font = "14px sans-serif"; c.fillText(second.textContent, 12, 54);
    c.font = "12px sans-serif"; c.fillText(third.textContent, 12, 72);
    c.font = "14px sans-serif"; others.textContent.split("\n").forEach((t, k) => c.fillText(t, 12, 92 + 18 * k));
    const h = gl.clientHeight;
    c.drawImage(bar, 12, h - 40, 180, 12);
    c.font = "12px sans-serif"; c.fillText(`0 to ${high.textContent}: ${what.textContent}`, 12, h - 12);
  }
  function save(blob, name) {
    const a = document.createElement("a");
    a.href = URL.createObjectURL(blob); a.download = name; a.click();
    setTimeout(() => URL.revokeObjectURL(a.href), 1000);
  }
  function png() {
    const canvas = document.createElement("canvas");
    compose(canvas); canvas.toBlob((b) => save(b, "trachea.png"));
  }
  function film(e) {
    if (filming) { filming.recorder.stop(); return; }
    const canvas = document.createElement("canvas"); compose(canvas);
    const recorder = new MediaRecorder(canvas.captureStream(30)), parts = [];
    recorder.ondataavailable = (d) => parts.push(d.data);
    recorder.onstop = () => { filming = null; e.target.textContent = "film"; save(new Blob(parts, { type: recorder.mimeType }), "trachea.webm"); };
    filming = { recorder, canvas }; e.target.textContent = "end film"; recorder.start();
  }

  function draw() {
    if (!el.isConnected && stats.drawn) { removeEventListener("keydown", key); renderer.dispose(); return; }
    requestAnimationFrame(draw);
    const w = el.clientWidth, h = el.clientHeight, s = renderer.getSize(new T.Vector2());
    if (w && h && (s.x !== w || s.y !== h)) {
      renderer.setSize(w, h); camera.aspect = w / h; camera.updateProjectionMatrix(); dirty = true;
    }
    if (!dirty) return;
    dirty = false; renderer.render(world, camera); stats.drawn++;
    if (filming) compose(filming.canvas);
    for (const [label, side] of names) {
      const p = new T.Vector3(middle.x + side * size, middle.y, middle.z).project(camera);
      label.style.left = `${Math.min(Math.max(((p.x + 1) / 2) * w - 18, 4), w - 48)}px`;
      label.style.top = `${Math.min(Math.max(((1 - p.y) / 2) * h + 14, 60), h - 70)}px`;
    }
  }
  function look() { // at all of the tube
    const far = size * Math.min(Math.max((1.5 * el.clientHeight) / el.clientWidth || 1, 0.85), 3);
    orbit.target.copy(middle);
    camera.position.set(-0.8, 1.3, 2.6).multiplyScalar(far).add(middle); orbit.update(); dirty = true;
  }
  function screen(p = tool.position) {
    const q = p.clone().project(camera), b = renderer.domElement.getBoundingClientRect();
    return [b.left + ((q.x + 1) / 2) * b.width, b.top + ((1 - q.y) / 2) * b.height];
  }
  posed(scene.poses.flat()); look(); paint(); draw();
  function finite() { return surface.array.every(Number.isFinite); }
  return { frame, show, posed, finite, positions: () => surface.array, deviation: scene.step, pose, look, screen, set, stats, png, get last() { return last; },
    place(x, y, z) { tool.position.set(x, y, z); moved(); }, take, send() { onPose(option.tool, pose()); } };
}
