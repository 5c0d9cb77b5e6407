// Cameras and sparse points, turned by mouse or touch. Scene axes; z up.

const decodeBase64 = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0));

function median(values) {
  const sorted = Float64Array.from(values).sort();
  return sorted[sorted.length >> 1];
}

// geometry: the page data's; onChoose(name): a held-out camera was clicked.
function makeSpace(geometry, onChoose) {
  const cameras = geometry.cameras.map((camera) => {
    const m = camera.scene_from_camera;
    return {...camera, center: [m[3], m[7], m[11]], axes: [0, 1, 2].map((k) => [m[k], m[4 + k], m[8 + k]])};
  });
  const positions = geometry.points ? new Float32Array(decodeBase64(geometry.points.positions).buffer) : new Float32Array();
  const colors = geometry.points ? decodeBase64(geometry.points.colors) : new Uint8Array();
  const nPoints = positions.length / 3;

  // What is looked at: where the points are, with every camera in sight.
  const column = (k) => Array.from({length: nPoints}, (_, i) => positions[3 * i + k]);
  const target = [0, 1, 2].map((k) => median(nPoints > 0 ? column(k) : cameras.map((camera) => camera.center[k])));
  const distances = cameras.map(({center}) => Math.hypot(...center.map((v, k) => v - target[k])));
  const radius = Math.max(...distances, 1e-6), size = 0.09 * median(distances);

  const canvas = el("canvas", {tabIndex: 0, role: "img", "aria-label": "Cameras and sparse points in 3D"});
  const tip = el("div", {className: "tip", hidden: true});
  const context = canvas.getContext("2d");
  const view = {};
  const reset = () => { Object.assign(view, {azimuth: -0.9, elevation: 0.5, distance: 2.4 * radius}); };
  let placed = [], pending = false;

  const draw = () => {
    pending = false;
    const ratio = Math.min(2, window.devicePixelRatio || 1);
    const width = canvas.width = Math.round(canvas.clientWidth * ratio), height = canvas.height = Math.round(canvas.clientHeight * ratio);
    if (width === 0 || height === 0) return;
    const [ca, sa, ce, se] = [Math.cos(view.azimuth), Math.sin(view.azimuth), Math.cos(view.elevation), Math.sin(view.elevation)];
    const focal = 1.25 * Math.min(width, height);
    const project = (px, py, pz) => {  // px, depth
      const x = px - target[0], y = py - target[1], z = pz - target[2];
      const side = -sa * x + ca * y, front = ca * x + sa * y;
      const depth = view.distance - ce * front - se * z, up = -se * front + ce * z;
      return [width / 2 + focal * side / depth, height / 2 - focal * up / depth, depth];
    };

    const image = context.createImageData(width, height), pixels = new Uint32Array(image.data.buffer);
    pixels.fill(0xff110d0b);
    const nearest = new Float32Array(width * height).fill(Infinity), dot = Math.max(2, Math.round(1.6 * ratio));
    for (let i = 0; i < nPoints; ++i) {
      const [px, py, depth] = project(positions[3 * i], positions[3 * i + 1], positions[3 * i + 2]);
      if (depth <= 0.02 * radius || px < 0 || py < 0 || px >= width - dot || py >= height - dot) continue;
      const color = 0xff000000 | colors[3 * i + 2] << 16 | colors[3 * i + 1] << 8 | colors[3 * i];
      for (let row = 0; row < dot; ++row) {
        for (let at = (Math.floor(py) + row) * width + Math.floor(px), end = at + dot; at < end; ++at) {
          if (depth < nearest[at]) { nearest[at] = depth; pixels[at] = color; }
        }
      }
    }
    context.putImageData(image, 0, 0);

    placed = [];
    for (const camera of cameras) {
      const {center, axes} = camera, [right, down, forward] = axes;
      const corner = (sx, sy) => project(...center.map((v, k) =>
        v + size * (forward[k] + sx * camera.slope_x * right[k] + sy * camera.slope_y * down[k])));
      const apex = project(...center), corners = [corner(-1, -1), corner(1, -1), corner(1, 1), corner(-1, 1)];
      if ([apex, ...corners].some(([, , depth]) => depth <= 0.02 * radius)) continue;
      context.strokeStyle = camera.split === "test" ? "#ffb169" : "#8fb0ff";
      context.lineWidth = (camera.split === "test" ? 1.8 : 1.2) * ratio;
      context.beginPath();
      for (const [x, y] of corners) { context.moveTo(apex[0], apex[1]); context.lineTo(x, y); }
      context.moveTo(corners[3][0], corners[3][1]);
      for (const [x, y] of corners) context.lineTo(x, y);
      context.stroke();
      placed.push({camera, x: apex[0] / ratio, y: apex[1] / ratio});
    }
  };
  const redraw = () => { if (!pending) { pending = true; requestAnimationFrame(draw); } };
  const zoom = (factor) => { view.distance = Math.min(20 * radius, Math.max(0.1 * radius, view.distance * factor)); redraw(); };
  const turn = (dx, dy) => {
    view.azimuth -= 0.008 * dx;
    view.elevation = Math.min(1.55, Math.max(-1.55, view.elevation + 0.008 * dy));
    redraw();
  };

  const at = (event) => {
    const box = canvas.getBoundingClientRect();
    const [x, y] = [event.clientX - box.left, event.clientY - box.top];
    const near = placed.map((p) => ({...p, distance: Math.hypot(p.x - x, p.y - y)})).sort((a, b) => a.distance - b.distance)[0];
    return near && near.distance < 14 ? near : null;
  };
  const pointers = new Map();
  let moved = 0;
  const span = () => {
    const [a, b] = [...pointers.values()];
    return Math.hypot(a.clientX - b.clientX, a.clientY - b.clientY);
  };
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, event);
    canvas.classList.add("turning");
    moved = 0;
    tip.hidden = true;
  });
  canvas.addEventListener("pointermove", (event) => {
    const last = pointers.get(event.pointerId);
    if (!last) {
      const near = at(event);
      tip.hidden = !near;
      if (!near) return;
      tip.textContent = `${near.camera.name} · ${near.camera.split === "test" ? "held out" : "training"}`;
      tip.style.left = `${Math.min(near.x + 14, canvas.clientWidth - tip.offsetWidth - 8)}px`;
      tip.style.top = `${Math.max(8, near.y - 40)}px`;
      return;
    }
    moved += Math.abs(event.clientX - last.clientX) + Math.abs(event.clientY - last.clientY);
    const before = pointers.size === 2 ? span() : 0;
    pointers.set(event.pointerId, event);
    if (pointers.size === 1) turn(event.clientX - last.clientX, event.clientY - last.clientY);
    if (pointers.size === 2 && span() > 0) zoom(before / span());
  });
  const release = (event) => {
    pointers.delete(event.pointerId);
    if (pointers.size === 0) canvas.classList.remove("turning");
  };
  canvas.addEventListener("pointerup", (event) => {
    const near = moved < 5 ? at(event) : null;
    release(event);
    if (near && near.camera.split === "test") onChoose(near.camera.name);
  });
  canvas.addEventListener("pointercancel", release);
  canvas.addEventListener("pointerleave", () => { tip.hidden = true; });
  canvas.addEventListener("wheel", (event) => {  // with Ctrl, so that the page can be scrolled past it
    if (!event.ctrlKey && !event.metaKey) return;
    event.preventDefault();
    zoom(Math.exp(0.002 * event.deltaY));
  }, {passive: false});
  canvas.addEventListener("keydown", (event) => {
    const step = {ArrowLeft: [-12, 0], ArrowRight: [12, 0], ArrowUp: [0, -12], ArrowDown: [0, 12]}[event.key];
    if (step) { event.preventDefault(); turn(...step); }
    if (event.key === "+") zoom(0.85);
    if (event.key === "-") zoom(1.18);
  });
  const button = (label, title, action) => el("button", {type: "button", title, "aria-label": title, onclick: action}, label);
  const controls = el("div", {className: "controls"}, button("+", "Nearer", () => zoom(0.8)), button("−", "Farther", () => zoom(1.25)),
    button("Reset", "Back to the first view", () => { reset(); redraw(); }));
  const element = el("div", {className: "space"}, canvas, tip, controls);
  reset();
  new ResizeObserver(redraw).observe(canvas);
  return element;
}
