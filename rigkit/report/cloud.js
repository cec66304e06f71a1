// A dense cloud that turns: points of one packed array, drawn into an image with a depth for every pixel. No library and
// no graphics card is needed for a hundred thousand points. Drag turns, with shift moves, wheel zooms, double click resets.
// Packed: float32 places x, y, z (x right, y down, z forward; about the middle, in units of the reach), int8 normals over
// 127, uint8 red, green, blue.
"use strict";

const CLOUD_START = {yaw: -0.3, pitch: 0.2, zoom: 1, u: 0, v: 0};
const CLOUD_DISTANCE = 2.6;
const CLOUD_FILL = 1.3;
const CLOUD_SHARE = 0.88;
const CLOUD_INSIDE = 0.99;
const NEAREST = 0.1;
const MAX_PX = 7;

function cloudView(canvas) {
  const packed = Uint8Array.from(atob(document.getElementById(canvas.dataset.cloud).textContent), (c) => c.charCodeAt(0));
  const count = Number(canvas.dataset.count), spacing = Number(canvas.dataset.spacing);
  const places = new Float32Array(packed.buffer, 0, 3 * count);
  const normals = new Int8Array(packed.buffer, 12 * count, 3 * count), colours = packed.subarray(15 * count);
  const tools = canvas.parentElement, pen = canvas.getContext("2d", {willReadFrequently: true});
  const shape = tools.querySelector("[data-shape]"), turning = tools.querySelector("[data-turn]");
  let view = null, image = null, depths = null, asked = false;

  // The first view, zoomed and moved until nearly all points fill the canvas.
  function fitted() {
    const start = CLOUD_START, cy = Math.cos(start.yaw), sy = Math.sin(start.yaw);
    const cp = Math.cos(start.pitch), sp = Math.sin(start.pitch);
    const across = [], along = [];
    for (let j = 0; j < 3 * count; j += 3) {
      const ahead = cy * places[j + 2] - sy * places[j], far = cp * ahead - sp * places[j + 1] + CLOUD_DISTANCE;
      if (far < NEAREST) continue;
      across.push((cy * places[j] + sy * places[j + 2]) / far);
      along.push((cp * places[j + 1] + sp * ahead) / far);
    }
    const width = canvas.clientWidth, height = canvas.clientHeight, scale = CLOUD_FILL * Math.min(width, height);
    const ends = [across, along].map((own) => {
      const sorted = Float64Array.from(own).sort(), last = sorted.length - 1;
      return [sorted[Math.floor((1 - CLOUD_INSIDE) * last)] * scale, sorted[Math.ceil(CLOUD_INSIDE * last)] * scale];
    });
    const zoom = CLOUD_SHARE * Math.min(width / (ends[0][1] - ends[0][0]), height / (ends[1][1] - ends[1][0]));
    if (!Number.isFinite(zoom)) return {...start};
    return {...start, zoom, u: (-zoom * (ends[0][0] + ends[0][1])) / 2, v: (-zoom * (ends[1][0] + ends[1][1])) / 2};
  }

  function draw() {
    asked = false;
    if (!canvas.clientWidth) return;
    view = view || fitted();
    const begin = performance.now(), ratio = window.devicePixelRatio || 1;
    const width = Math.round(canvas.clientWidth * ratio), height = Math.round(canvas.clientHeight * ratio);
    if (!image || canvas.width !== width || canvas.height !== height) {
      canvas.width = width;
      canvas.height = height;
      image = pen.createImageData(width, height);
      depths = new Float32Array(width * height);
    }
    const out = new Uint32Array(image.data.buffer), lit = shape.checked;
    out.fill(0);
    depths.fill(Infinity);
    const cy = Math.cos(view.yaw), sy = Math.sin(view.yaw), cp = Math.cos(view.pitch), sp = Math.sin(view.pitch);
    const scale = view.zoom * CLOUD_FILL * Math.min(width, height);
    const middle = width / 2 + view.u * ratio, centre = height / 2 + view.v * ratio;
    for (let k = 0, j = 0; k < count; k++, j += 3) {
      const x = places[j], y = places[j + 1], z = places[j + 2];
      const aside = cy * x + sy * z, ahead = cy * z - sy * x;
      const down = cp * y + sp * ahead, far = cp * ahead - sp * y + CLOUD_DISTANCE;
      if (far < NEAREST) continue;
      const here = scale / far, side = Math.min(MAX_PX, Math.ceil(spacing * here));
      const left = Math.round(middle + here * aside - side / 2), top = Math.round(centre + here * down - side / 2);
      if (left < 0 || top < 0 || left + side > width || top + side > height) continue;
      let red = colours[j], green = colours[j + 1], blue = colours[j + 2];
      if (lit) {
        const facing = cp * (sy * normals[j] - cy * normals[j + 2]) + sp * normals[j + 1];
        red = green = blue = 60 + 1.5 * Math.max(0, facing);
      }
      const colour = (255 << 24) | (blue << 16) | (green << 8) | red;
      for (let row = top; row < top + side; row++) {
        for (let at = row * width + left, end = at + side; at < end; at++) {
          if (far < depths[at]) {
            depths[at] = far;
            out[at] = colour;
          }
        }
      }
    }
    pen.putImageData(image, 0, 0);
    canvas.dataset.view = `${view.yaw.toFixed(3)} ${view.pitch.toFixed(3)} ${view.zoom.toFixed(3)}`;
    canvas.dataset.ms = (performance.now() - begin).toFixed(2);
    if (turning.checked) turn();
  }

  function ask() {
    if (!asked) requestAnimationFrame(draw);
    asked = true;
  }

  function turn() {
    view.yaw += TURN_PER_PX;
    ask();
  }

  function shifted(dx, dy) {
    view.u += dx;
    view.v += dy;
  }

  turnable(canvas, () => view, ask, {reset: () => (view = fitted()), shifted});
  for (const box of [shape, turning]) box.addEventListener("change", ask);
  window.addEventListener("resize", ask);
  window.addEventListener("beforeprint", draw);
  draw();
}

for (const canvas of document.querySelectorAll("canvas[data-cloud]")) cloudView(canvas);
