// play.html: the rows of a recording by core.js, without a server.
import { THREE, OrbitControls } from "three-bundle";
import { mount, unpack } from "core";
const bytes = Uint8Array.from(atob(document.getElementById("packet").textContent), (c) => c.charCodeAt(0));
const scene = unpack(bytes.buffer), { heads, poses, moves, rest } = scene.arrays;
const rows = scene.rows.length, size = rest.length, place = new Float32Array(size);
const [long, wide] = [heads, poses].map((all) => all.length / rows);
const [button, slider, which] = ["play", "row", "which"].map((id) => document.getElementById(id));
const view = mount(THREE, OrbitControls, document.getElementById("view"), scene, { movable: false });
slider.max = rows - 1;
function show(row) {
  const head = heads.subarray(long * row, long * (row + 1)), solved = head[0] > 0;
  view.posed(poses.subarray(wide * row, wide * (row + 1)));
  for (let i = 0; solved && i < size; i++) place[i] = rest[i] + scene.step * moves[size * row + i];
  view.show(head, solved ? place : null);
  slider.value = row;
  which.textContent = `row ${scene.rows[row]} of ${scene.of}`;
}
let timer = null;
function stop() { clearInterval(timer); timer = null; button.textContent = "play"; }
button.onclick = () => {
  if (timer !== null) return stop();
  button.textContent = "pause";
  timer = setInterval(() => show((+slider.value + 1) % rows), Math.max(40, Math.min(200, 6000 / rows)));
};
slider.oninput = () => show(+slider.value);
show(0);
window.trachea = view;
