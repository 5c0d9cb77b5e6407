// Held-out views: the photo on the left of a slider, what the model makes of it on the right.

const LAYERS = [["rendered", "Render"], ["error", "Error"], ["depth", "Depth"], ["normal", "Normals"]];

// Colours of "inferno", at equal steps.
const INFERNO = ["#000004", "#160b39", "#420a68", "#6a176e", "#932667", "#bc3754", "#dd513a", "#f37819", "#fca50a", "#f6d746", "#fcffa4"];

// Stretches a grey picture between its darkest and brightest values (black: nothing was hit) and colours it, near bright.
async function colourDepth(uri) {
  const image = new Image();
  image.src = uri;
  try {
    await image.decode();
  } catch {
    return uri;  // a damaged file shows as one
  }
  const canvas = el("canvas", {width: image.naturalWidth, height: image.naturalHeight});
  const context = canvas.getContext("2d", {willReadFrequently: true});
  context.drawImage(image, 0, 0);
  const pixels = context.getImageData(0, 0, canvas.width, canvas.height), data = pixels.data;
  const histogram = new Array(256).fill(0);
  for (let i = 0; i < data.length; i += 4) ++histogram[data[i]];
  const total = data.length / 4 - histogram[0];
  const quantile = (share) => {
    let sum = 0;
    for (let value = 1; value < 256; ++value) if ((sum += histogram[value]) >= share * total) return value;
    return 255;
  };
  const low = quantile(0.01), high = Math.max(low + 1, quantile(0.99));
  const stops = INFERNO.map((hex) => [1, 3, 5].map((at) => parseInt(hex.slice(at, at + 2), 16)));
  for (let i = 0; i < data.length; i += 4) {
    if (data[i] === 0) continue;
    const near = 1 - Math.min(1, Math.max(0, (data[i] - low) / (high - low)));
    const place = (0.1 + 0.9 * near) * (stops.length - 1), stop = Math.min(stops.length - 2, Math.floor(place));
    for (let c = 0; c < 3; ++c) data[i + c] = stops[stop][c] + (place - stop) * (stops[stop + 1][c] - stops[stop][c]);
  }
  context.putImageData(pixels, 0, 0);
  return canvas.toDataURL("image/png");
}

// pictures: the page data's; images: the summary's; errorRange: image values the error colours span.
// Returns {element, show(image index) → whether there are pictures of it, onShow: set by the caller}.
function makeViewer(pictures, images, errorRange) {
  const left = el("img", {alt: "Photo", draggable: false}), right = el("img", {draggable: false});
  const handle = el("div", {className: "handle"});
  const rightTag = el("span", {className: "tag right"});
  const frame = el("div", {className: "frame", tabIndex: 0, role: "slider", "aria-label": "Divider between photo and render",
    "aria-valuemin": 0, "aria-valuemax": 100}, right, left, handle, el("span", {className: "tag left"}, "Photo"), rightTag);
  const compare = el("div", {className: "compare"}, frame);
  const layers = el("div", {className: "layers", role: "group", "aria-label": "Shown on the right"});
  const caption = el("div", {className: "viewer-caption"});
  const film = el("div", {className: "film", role: "group", "aria-label": "Views"});
  const stage = el("div", {className: "viewer"}, compare, layers);
  const viewer = {element: el("div", {}, stage, caption, film), onShow: () => {}};
  let view = null, layer = "rendered", share = 0.5;

  const split = (value) => {
    share = Math.min(1, Math.max(0, value));
    left.style.clipPath = `inset(0 ${100 * (1 - share)}% 0 0)`;
    handle.style.left = `${100 * share}%`;
    frame.setAttribute("aria-valuenow", Math.round(100 * share));
  };
  const drag = (event) => {
    const box = frame.getBoundingClientRect();
    split((event.clientX - box.left) / box.width);
  };
  compare.addEventListener("pointerdown", (event) => { compare.setPointerCapture(event.pointerId); drag(event); });
  compare.addEventListener("pointermove", (event) => { if (compare.hasPointerCapture(event.pointerId)) drag(event); });
  frame.addEventListener("keydown", (event) => {
    const step = {ArrowLeft: -0.02, ArrowRight: 0.02, Home: -1, End: 1}[event.key];
    if (step === undefined) return;
    event.preventDefault();
    split(share + step);
  });

  const fit = () => {
    if (!view) return;
    const {width, height} = images[view.image];
    const scale = Math.min(compare.clientWidth / width, compare.clientHeight / height);
    frame.style.width = `${width * scale}px`;
    frame.style.height = `${height * scale}px`;
  };
  new ResizeObserver(() => requestAnimationFrame(fit)).observe(compare);

  const showCaption = () => {
    const image = images[view.image];
    caption.replaceChildren(
      el("b", {}, image.name),
      el("span", {}, image.identical ? "identical to the photo" : `PSNR ${format.psnr(image.psnr)} dB`),
      el("span", {}, `SSIM ${format.ssim(image.ssim)}`),
      el("span", {className: "muted"}, `${image.width} × ${image.height} px`));
    if (layer !== "error") return;
    caption.append(el("span", {className: "scale"}, "error 0",
      el("i", {style: `background: linear-gradient(90deg, ${INFERNO.join(", ")})`}), `≥ ${errorRange} of the value range`));
  };
  const showLayer = (name) => {
    layer = view[name] ? name : "rendered";
    const label = LAYERS.find(([key]) => key === layer)[1];
    right.src = view[layer];
    right.alt = rightTag.textContent = label;
    for (const button of layers.children) button.setAttribute("aria-pressed", button.dataset.layer === layer);
    showCaption();
  };
  viewer.show = (index) => {
    const found = pictures.views.find((candidate) => candidate.image === index);
    if (!found) return false;
    view = found;
    left.src = view.truth;
    layers.replaceChildren(...LAYERS.filter(([key]) => view[key]).map(([key, label]) => {
      const button = el("button", {type: "button", onclick: () => showLayer(key)},
        el("img", {src: view[key], alt: "", loading: "lazy"}), el("span", {}, label));
      button.dataset.layer = key;
      return button;
    }));
    for (const button of film.children) button.setAttribute("aria-pressed", button.dataset.image === String(index));
    stage.classList.toggle("portrait", images[index].height > images[index].width);
    fit();
    showLayer(layer);
    viewer.onShow(index);
    return true;
  };

  for (const candidate of pictures.views) {
    const image = images[candidate.image];
    const button = el("button", {type: "button", title: image.name, onclick: () => viewer.show(candidate.image)},
      el("img", {src: candidate.rendered, alt: image.name, loading: "lazy"}),
      el("span", {}, image.identical ? "identical" : `${format.psnr(image.psnr)} dB`));
    button.dataset.image = candidate.image;
    film.append(button);
    if (candidate.depth) {
      colourDepth(candidate.depth).then((coloured) => {
        candidate.depth = coloured;
        if (view === candidate) viewer.show(candidate.image);
      });
    }
  }
  film.hidden = pictures.views.length < 2;
  split(0.5);
  return viewer;
}
