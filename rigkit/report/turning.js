// A canvas whose view turns: drag or arrow keys turn, wheel or plus and minus zoom, a double click resets.
"use strict";

const TURN_PER_PX = 0.008;

// `view()`: the {yaw, pitch, zoom} that is changed; `draw()` shows it; `reset()` puts back the first one. While no button
// is down the pointer goes to `hover(e)`; `shifted(dx, dy)` gets drags with shift.
function turnable(canvas, view, draw, {reset, hover = null, shifted = null}) {
  let last = null;
  const turn = (yaw, pitch) => {
    view().yaw += yaw;
    view().pitch += pitch;
  };
  canvas.addEventListener("pointerdown", (e) => {
    last = [e.clientX, e.clientY];
    canvas.setPointerCapture(e.pointerId);
  });
  canvas.addEventListener("pointermove", (e) => {
    if (!last) {
      if (hover) hover(e);
      return;
    }
    const [dx, dy] = [e.clientX - last[0], e.clientY - last[1]];
    last = [e.clientX, e.clientY];
    if (shifted && e.shiftKey) {
      shifted(dx, dy);
    } else {
      turn(-dx * TURN_PER_PX, dy * TURN_PER_PX);
      view().pitch = Math.max(-1.57, Math.min(1.57, view().pitch));
    }
    draw();
  });
  canvas.addEventListener("pointerup", () => (last = null));
  canvas.addEventListener("wheel", (e) => {
    e.preventDefault();
    view().zoom *= Math.exp(-e.deltaY * 0.001);
    draw();
  }, {passive: false});
  canvas.addEventListener("dblclick", () => {
    reset();
    draw();
  });
  canvas.addEventListener("keydown", (e) => {
    const step = {ArrowLeft: [-0.1, 0, 1], ArrowRight: [0.1, 0, 1], ArrowUp: [0, 0.1, 1], ArrowDown: [0, -0.1, 1],
      "+": [0, 0, 1.15], "-": [0, 0, 1 / 1.15]}[e.key];
    if (!step) return;
    e.preventDefault();
    turn(step[0], step[1]);
    view().zoom *= step[2];
    draw();
  });
}
