// A small 3D view on a 2D canvas: oriented points, camera pyramids, planes. Drag turns, wheel zooms, double click resets.
// A scene: {points:[[x,y,z]..], normals:[..], board:[..], boards:[names], cameras:[{name, corners:[tip,a,b,c,d]}],
// planes:[{board, corners:[a,b,c,d]}], square_mm}. Camera axes: x right, y down, z forward.
"use strict";

const COLOURS = ["#e6550d", "#1f77b4", "#2ca02c", "#9467bd", "#b79a00", "#17becf", "#e377c2", "#7f7f7f"];
const START = {yaw: -0.45, pitch: 0.45, zoom: 1};
const TURN_PER_PX = 0.008;
const DISTANCE = 3.2;
const FILL = 2.1;

function viewer(canvas, scene) {
  const show = {normals: true, cameras: true, planes: true};
  let view = {...START};
  const all = scene.points.concat(...scene.cameras.map((c) => c.corners));
  const middle = [0, 1, 2].map((k) => (Math.min(...all.map((p) => p[k])) + Math.max(...all.map((p) => p[k]))) / 2);
  const reach = Math.max(...all.map((p) => Math.hypot(p[0] - middle[0], p[1] - middle[1], p[2] - middle[2])));

  function project(p) {
    const x = (p[0] - middle[0]) / reach, y = (p[1] - middle[1]) / reach, z = (p[2] - middle[2]) / reach;
    const cy = Math.cos(view.yaw), sy = Math.sin(view.yaw), cp = Math.cos(view.pitch), sp = Math.sin(view.pitch);
    const x1 = cy * x + sy * z, z1 = -sy * x + cy * z;
    const y2 = cp * y + sp * z1, z2 = -sp * y + cp * z1 + DISTANCE;
    const scale = view.zoom * FILL * Math.min(canvas.width, canvas.height) / z2;
    return [canvas.width / 2 + scale * x1, canvas.height / 2 + scale * y2, z2];
  }

  function draw() {
    const ratio = window.devicePixelRatio || 1;
    canvas.width = canvas.clientWidth * ratio;
    canvas.height = canvas.clientHeight * ratio;
    const pen = canvas.getContext("2d");
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
        pen.fillStyle = COLOURS[plane.board % COLOURS.length] + "22";
        pen.beginPath();
        plane.corners.map(project).forEach((p, i) => (i ? pen.lineTo(p[0], p[1]) : pen.moveTo(p[0], p[1])));
        pen.closePath();
        pen.fill();
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
          line(tip, corner, "#333");
          line(corner, base[(i + 1) % base.length], "#333");
        });
        const p = project(tip);
        pen.fillStyle = "#333";
        pen.font = `${12 * ratio}px sans-serif`;
        pen.fillText(camera.name, p[0] + 6 * ratio, p[1]);
      }
    }
    canvas.dataset.view = `${view.yaw.toFixed(3)} ${view.pitch.toFixed(3)} ${view.zoom.toFixed(3)}`;
  }

  let last = null;
  canvas.addEventListener("pointerdown", (e) => {
    last = [e.clientX, e.clientY];
    canvas.setPointerCapture(e.pointerId);
  });
  canvas.addEventListener("pointermove", (e) => {
    if (!last) return;
    view.yaw -= (e.clientX - last[0]) * TURN_PER_PX;
    view.pitch = Math.max(-1.57, Math.min(1.57, view.pitch + (e.clientY - last[1]) * TURN_PER_PX));
    last = [e.clientX, e.clientY];
    draw();
  });
  canvas.addEventListener("pointerup", () => (last = null));
  canvas.addEventListener("wheel", (e) => {
    e.preventDefault();
    view.zoom *= Math.exp(-e.deltaY * 0.001);
    draw();
  }, {passive: false});
  canvas.addEventListener("dblclick", () => {
    view = {...START};
    draw();
  });
  canvas.addEventListener("keydown", (e) => {
    const step = {ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1]}[e.key];
    if (!step) return;
    e.preventDefault();
    view.yaw += step[0];
    view.pitch += step[1];
    draw();
  });
  for (const box of canvas.parentElement.querySelectorAll("input[data-show]")) {
    box.addEventListener("change", () => {
      show[box.dataset.show] = box.checked;
      draw();
    });
  }
  window.addEventListener("resize", draw);
  window.addEventListener("beforeprint", draw);
  draw();
}

for (const canvas of document.querySelectorAll("canvas[data-scene]")) {
  viewer(canvas, JSON.parse(document.getElementById(canvas.dataset.scene).textContent));
}
