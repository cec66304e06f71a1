// A small 3D view on a 2D canvas: oriented points, camera pyramids, planes. Drag turns, wheel zooms, double click resets;
// what lies under the pointer is named; seen from the front, from above or from the side it is orthographic.
// A scene: {points:[[x,y,z]..], normals:[..], board:[..], boards:[names], cameras:[{name, corners:[tip,a,b,c,d]}],
// planes:[{board, corners:[a,b,c,d], name}], square_mm}. Camera axes: x right, y down, z forward.
"use strict";

const COLOURS = ["#e6550d", "#1f77b4", "#2ca02c", "#9467bd", "#b79a00", "#17becf", "#e377c2", "#7f7f7f"];
const START = {yaw: -0.45, pitch: 0.45, zoom: 1, flat: false};
const FROM = {free: START, front: {yaw: 0, pitch: 0, zoom: 1, flat: true}, top: {yaw: 0, pitch: Math.PI / 2, zoom: 1, flat: true},
  side: {yaw: Math.PI / 2, pitch: 0, zoom: 1, flat: true}};
const NEAR_PX = 14;
const SCALE_PX = 140;
const AXIS_PX = 36;
const DISTANCE = 3.2;
// As it is first turned, the scene reaches so far from the middle of the view to its edge.
const FILLED = 0.9;

function viewer(canvas, scene) {
  const show = {normals: true, cameras: true, planes: true};
  let view = {...START};
  let hovered = null;
  const all = scene.points.concat(...scene.cameras.map((c) => c.corners), ...scene.planes.map((p) => p.corners));
  const middle = [0, 1, 2].map((k) => (Math.min(...all.map((p) => p[k])) + Math.max(...all.map((p) => p[k]))) / 2);
  const reach = Math.max(...all.map((p) => Math.hypot(p[0] - middle[0], p[1] - middle[1], p[2] - middle[2])));

  // How large all is drawn, and the size of the view that this was found for.
  let fill = 1, fitted = "";

  function turned(p) {
    const x = (p[0] - middle[0]) / reach, y = (p[1] - middle[1]) / reach, z = (p[2] - middle[2]) / reach;
    const cy = Math.cos(view.yaw), sy = Math.sin(view.yaw), cp = Math.cos(view.pitch), sp = Math.sin(view.pitch);
    const z1 = -sy * x + cy * z;
    return [cy * x + sy * z, cp * y + sp * z1, -sp * y + cp * z1 + DISTANCE];
  }

  function project(p) {
    const [x, y, z] = turned(p), scale = view.zoom * fill / (view.flat ? DISTANCE : z);
    return [canvas.width / 2 + scale * x, canvas.height / 2 + scale * y, z];
  }

  function fit() {
    const beyond = all.map((p) => {
      const [x, y, z] = turned(p);
      return Math.max(Math.abs(x) / canvas.width, Math.abs(y) / canvas.height) / (view.flat ? DISTANCE : z);
    });
    fill = FILLED / 2 / Math.max(...beyond, 1e-9);
    fitted = `${canvas.width} ${canvas.height}`;
  }

  function draw() {
    if (!canvas.clientWidth) return;
    const ratio = window.devicePixelRatio || 1;
    canvas.width = canvas.clientWidth * ratio;
    canvas.height = canvas.clientHeight * ratio;
    if (fitted !== `${canvas.width} ${canvas.height}`) fit();
    const pen = canvas.getContext("2d");
    const wire = getComputedStyle(canvas).getPropertyValue("--wire").trim() || "#333";
    pen.clearRect(0, 0, canvas.width, canvas.height);
    pen.lineWidth = ratio;
    const line = (a, b, colour) => {
      const p = project(a), q = project(b);
      pen.strokeStyle = colour;
      pen.beginPath();
      pen.moveTo(p[0], p[1]);
      pen.lineTo(q[0], q[1]);
      pen.stroke();
    };
    if (show.planes) {
      for (const plane of scene.planes) {
        pen.fillStyle = COLOURS[plane.board % COLOURS.length] + (scene.planes.length > 8 ? "0c" : "22");
        pen.beginPath();
        plane.corners.map(project).forEach((p, i) => (i ? pen.lineTo(p[0], p[1]) : pen.moveTo(p[0], p[1])));
        pen.closePath();
        pen.fill();
        pen.strokeStyle = COLOURS[plane.board % COLOURS.length] + (plane === hovered ? "ff" : "88");
        pen.stroke();
      }
    }
    // Far points first, so that near ones lie on top.
    const order = scene.points.map((p, i) => [project(p), i]).sort((a, b) => b[0][2] - a[0][2]);
    for (const [p, i] of order) {
      const colour = COLOURS[scene.board[i] % COLOURS.length];
      if (show.normals) {
        const n = scene.normals[i], x = scene.points[i], s = 0.8 * scene.square_mm;
        line(x, [x[0] + s * n[0], x[1] + s * n[1], x[2] + s * n[2]], colour + "99");
      }
      pen.fillStyle = colour;
      pen.beginPath();
      pen.arc(p[0], p[1], 2.2 * ratio, 0, 2 * Math.PI);
      pen.fill();
    }
    if (show.cameras) {
      for (const camera of scene.cameras) {
        const [tip, ...base] = camera.corners;
        base.forEach((corner, i) => {
          line(tip, corner, wire);
          line(corner, base[(i + 1) % base.length], wire);
        });
      }
      names(pen, ratio, wire);
    }
    scaleBar(pen, ratio, wire);
    legend(pen, ratio, wire);
    canvas.dataset.view = `${view.yaw.toFixed(3)} ${view.pitch.toFixed(3)} ${view.zoom.toFixed(3)}`;
  }

  // Each camera's name behind its tip, where it covers no line of it, and below names that are there already.
  function names(pen, ratio, wire) {
    const high = 12 * ratio, rim = 4 * ratio, taken = [];
    // Around its letters the page shows, so that lines of others end there.
    const page = getComputedStyle(canvas).getPropertyValue("--page").trim() || "#fff";
    pen.lineJoin = "round";
    pen.font = `${high}px sans-serif`;
    for (const camera of scene.cameras) {
      const [tip, ...base] = camera.corners.map(project);
      const behind = [0, 1].map((k) => tip[k] - base.reduce((s, q) => s + q[k], 0) / base.length);
      const scale = 8 * ratio / (Math.hypot(...behind) || 1), wide = pen.measureText(camera.name).width;
      const left = tip[0] + scale * behind[0] - (behind[0] < 0 ? wide : 0);
      const x = Math.max(rim, Math.min(left, canvas.width - wide - rim));
      let y = Math.max(high, tip[1] + scale * behind[1] + (behind[1] > 0 ? 0.8 : 0.3) * high);
      while (taken.some((other) => Math.abs(other.y - y) < high && x < other.x + other.wide && other.x < x + wide)) {
        y += 0.25 * high;
      }
      taken.push({x, y, wide});
      pen.strokeStyle = page;
      pen.lineWidth = 4 * ratio;
      pen.strokeText(camera.name, x, y);
      pen.lineWidth = ratio;
      pen.fillStyle = wire;
      pen.fillText(camera.name, x, y);
    }
  }

  // A round length that is some SCALE_PX long: true at the middle of the scene.
  function scaleBar(pen, ratio, wire) {
    const pxPerMm = view.zoom * fill / DISTANCE / reach;
    const rough = SCALE_PX * ratio / pxPerMm, power = 10 ** Math.floor(Math.log10(rough));
    const length = Math.max(...[1, 2, 5].map((m) => m * power).filter((m) => m <= rough));
    const x = 14 * ratio, y = canvas.height - 14 * ratio;
    pen.strokeStyle = pen.fillStyle = wire;
    pen.lineWidth = 2 * ratio;
    pen.beginPath();
    pen.moveTo(x, y);
    pen.lineTo(x + length * pxPerMm, y);
    pen.stroke();
    pen.lineWidth = ratio;
    pen.font = `${12 * ratio}px sans-serif`;
    pen.fillText(length >= 1000 ? `${length / 1000} m` : `${length} mm`, x, y - 6 * ratio);
    // The axes of the first camera beside it.
    const origin = project(middle), step = 0.12 * reach, perPx = AXIS_PX * ratio / (step * pxPerMm);
    [["x", "#e53935"], ["y", "#43a047"], ["z", "#1e88e5"]].forEach(([name, colour], k) => {
      const tip = project(middle.map((m, i) => m + (i === k ? step : 0)));
      const to = [tip[0] - origin[0], tip[1] - origin[1]].map((d) => d * perPx);
      const at = [canvas.width - 60 * ratio, canvas.height - 60 * ratio];
      pen.strokeStyle = pen.fillStyle = colour;
      pen.beginPath();
      pen.moveTo(...at);
      pen.lineTo(at[0] + to[0], at[1] + to[1]);
      pen.stroke();
      pen.fillText(name, at[0] + 1.2 * to[0], at[1] + 1.2 * to[1]);
    });
  }

  function legend(pen, ratio, wire) {
    pen.font = `${12 * ratio}px sans-serif`;
    scene.boards.slice(0, COLOURS.length).forEach((name, k) => {
      pen.fillStyle = COLOURS[k];
      pen.fillRect(14 * ratio, (14 + 18 * k) * ratio, 10 * ratio, 10 * ratio);
      pen.fillStyle = wire;
      pen.fillText(name, 30 * ratio, (23 + 18 * k) * ratio);
    });
  }

  // The camera or plane whose middle is nearest to the pointer, in words.
  function under(e) {
    const box = canvas.getBoundingClientRect(), ratio = window.devicePixelRatio || 1;
    const at = [(e.clientX - box.left) * ratio, (e.clientY - box.top) * ratio];
    const mean = (corners) => [0, 1, 2].map((k) => corners.reduce((s, c) => s + c[k], 0) / corners.length);
    const things = scene.planes.filter((p) => p.name).map((p) => [p, mean(p.corners)]);
    things.push(...scene.cameras.map((c) => [c, c.corners[0]]));
    const far = things.map(([thing, p]) => [Math.hypot(project(p)[0] - at[0], project(p)[1] - at[1]), thing, p]);
    const best = far.sort((a, b) => a[0] - b[0])[0];
    if (!best || best[0] > 3 * NEAR_PX * ratio) return [null, ""];
    const where = best[2].map((v) => v.toFixed(0)).join(", ");
    return [best[1], `${best[1].name} at (${where}) mm`];
  }

  function told(e) {
    const [thing, words] = under(e);
    if (thing === hovered) return;
    hovered = thing;
    const place = canvas.parentElement.querySelector(".hover");
    if (place) place.textContent = words;
    draw();
  }

  function start(from) {
    view = {...from};
    fitted = "";
  }

  turnable(canvas, () => view, draw, {reset: () => start(START), hover: told});
  for (const box of canvas.parentElement.querySelectorAll("input[data-show]")) {
    box.addEventListener("change", () => {
      show[box.dataset.show] = box.checked;
      draw();
    });
  }
  for (const press of canvas.parentElement.querySelectorAll("button[data-from]")) {
    press.addEventListener("click", () => {
      start(FROM[press.dataset.from]);
      draw();
    });
  }
  window.addEventListener("resize", draw);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
  window.addEventListener("beforeprint", draw);
  draw();
}

for (const canvas of document.querySelectorAll("canvas[data-scene]")) {
  viewer(canvas, JSON.parse(document.getElementById(canvas.dataset.scene).textContent));
}
