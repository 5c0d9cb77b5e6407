// The page: sections in order, each left out when there is nothing to show in it.
const {summary, facts, pictures, geometry, certificate, videos, stability} = DATA;
const main = document.querySelector("main");

function addSection(id, title, hint, ...children) {
  main.append(el("section", {id}, el("h2", {}, title), el("p", {className: "hint"}, hint), ...children));
  byId("nav").append(el("a", {href: `#${id}`}, title));
}

const pairs = (object) => el("dl", {className: "pairs"},
  ...Object.entries(object ?? {}).flatMap(([key, value]) => [el("dt", {}, words(key)), el("dd", {}, format.any(value))]));

const plural = (n, word) => `${format.count(n)} ${word}${n === 1 ? "" : "s"}`;

function showStatus() {
  const {status, failure} = summary;
  byId("status").textContent = {complete: "Report", failed: `Stopped at ${failure?.stage}`, incomplete: "Not finished"}[status];
  byId("status").classList.toggle("failed", status === "failed");
  const {ingest = {}, train = {}} = facts;
  const parts = [];
  if (isNumber(ingest.n_images)) {
    const {train: nTrain, test: nTest} = summary.split;
    parts.push(plural(ingest.n_images, "photo") + (isNumber(nTest) ? `, ${nTrain} to train on and ${nTest} held out (${ingest.split_rule})` : ""));
  }
  if (isNumber(train.steps)) parts.push(`${format.count(train.steps)} training steps${train.preset ? ` with the preset “${train.preset}”` : ""}`);
  byId("lead").textContent = parts.length > 0 ? `${parts.join(". ")}.` : "Nothing has been made from this capture yet.";
  if (!failure) return;
  byId("failure").append(el("div", {className: "notice bad"},
    el("p", {}, el("strong", {}, `${failure.stage} did not finish. `)), el("p", {}, failure.error),
    summary.stages.length > 0 ? el("p", {className: "small muted"}, "Below is what was complete before.") : null));
}

function showTiles() {
  const {metrics, split, training} = summary;
  const add = (label, value, unit = "", note = "", main = false) => {
    if (value === DASH || value === "") return;
    byId("tiles").append(el("div", {className: `tile${main ? " main" : ""}`}, el("dt", {}, label),
      el("dd", {}, value, unit ? el("small", {}, unit) : ""), note ? el("p", {}, note) : ""));
  };
  add("PSNR", format.psnr(metrics.psnr), "dB", `mean of ${plural(metrics.n_images, "held-out view")}`, true);
  add("SSIM", format.ssim(metrics.ssim), "", "1 is identical", true);
  const variants = facts.eval?.variants ?? {};
  if (summary.decisions.some(({feature, needed}) => feature === "exposure_correction" && needed)) {
    add("Colours fitted", format.psnr(variants.psnr_colour_fitted), "dB",
      `PSNR of the right halves of held-out views, exposure and white balance fitted on the left ones; ${format.psnr(variants.psnr_right_half)} dB without`);
  }
  if (isNumber(variants.psnr_whole)) {
    add("Whole images", format.psnr(variants.psnr_whole), "dB", "PSNR with the pixels that masks leave out of the other figures");
  }
  if (isNumber(metrics.lpips)) add("LPIPS", format.fixed(metrics.lpips, 3), "", "0 is identical");
  const registered = split.registered, total = facts.ingest?.n_images;
  const heldOut = isNumber(split.registered_test) ? `${split.registered_test} of ${split.test} held out` : "";
  if (isNumber(registered)) add(facts.ingest?.posed ? "Posed photos" : "Registered", String(registered), `of ${total}`, heldOut);
  add("Model", format.bytes(training.model_bytes), "", isNumber(training.n_parameters) ? `${format.large(training.n_parameters)} parameters` : "");
  add("Training", format.seconds(training.seconds), "", isNumber(training.steps) ? plural(training.steps, "step") : "");
  add("Rendering", format.seconds(facts.render?.seconds_per_view), "", "a view");
  if (summary.stages.length > 0) add("Total time", format.seconds(summary.total_seconds), "", "all stages");
  if (training.device) add("Device", String(training.device).toUpperCase(), "", isNumber(training.threads) ? plural(training.threads, "thread") : "");
}

function showWarnings() {
  if (summary.warnings.length === 0) return;
  byId("warnings").append(el("div", {className: "notice"}, el("strong", {}, "Worth knowing"),
    ...summary.warnings.map(({text, items}) => (items.length === 0 ? el("p", {}, text)
      : el("details", {}, el("summary", {}, text), el("ul", {}, ...items.map((item) => el("li", {}, item))))))));
}

function showImages() {
  const {images, metrics} = summary;
  if (images.length === 0) return null;
  const shown = pictures?.views ?? [];
  const errorRange = summary.protocol?.error_map?.range?.[1] ?? 1;
  const viewer = shown.length > 0 ? makeViewer(pictures, images, errorRange) : null;

  const best = Math.max(...images.map((image) => image.psnr ?? 0)), worst = Math.min(...images.map((image) => image.psnr ?? best));
  const psnrCell = (image) => {
    const bar = el("i", {style: `width: ${image.identical ? 100 : 12 + 88 * (image.psnr - worst) / Math.max(best - worst, 1e-9)}%`});
    return el("span", {}, image.identical ? "identical" : format.psnr(image.psnr), el("span", {className: "bar"}, bar));
  };
  const columns = [
    {label: "Photo", value: (image) => image.name},
    {label: "PSNR (dB)", number: true, value: (image) => (image.identical ? Infinity : image.psnr), cell: psnrCell},
    {label: "SSIM", number: true, value: (image) => image.ssim, cell: (image) => format.ssim(image.ssim)},
  ];
  if (isNumber(metrics.lpips)) {
    columns.push({label: "LPIPS", number: true, value: (image) => image.lpips, cell: (image) => format.fixed(image.lpips, 3)});
  }
  const table = makeTable(columns, images, {long: true});
  images.forEach((image, index) => {
    const line = table.rows.get(image);
    if (!shown.some((view) => view.image === index)) return;
    line.className = "link";
    line.title = "Show its pictures";
    line.onclick = () => { viewer.show(index); viewer.element.scrollIntoView({block: "nearest"}); };
  });
  if (viewer) {
    viewer.onShow = (index) => images.forEach((image, i) => table.rows.get(image).classList.toggle("chosen", i === index));
    const order = shown.map((view) => view.image).sort((a, b) => (images[a].psnr ?? Infinity) - (images[b].psnr ?? Infinity));
    viewer.show(order[order.length >> 1]);
  }
  addSection("views", "Held-out views",
    "Photos the model has never seen. Drag the divider to compare a photo with what the model makes of its camera.",
    viewer?.element ?? "", pictures?.note ? el("p", {className: "hint"}, pictures.note) : "");
  addSection("figures", "Figures per view", `Sort by clicking a heading.${metrics.lpips_reason ? ` LPIPS is left out: ${metrics.lpips_reason}.` : ""}`, table.element);
  return viewer;
}

function showTraining() {
  const {training} = summary;
  if (!training.curve.some((point) => isNumber(point.seconds) && isNumber(point.psnr))) return;
  const rate = facts.train?.steps_per_second;
  addSection("training", "Training",
    `Held-out PSNR over training time, evaluations not counted${isNumber(rate) ? `; ${format.fixed(rate, 1)} steps a second` : ""}.`, makeCurve(training.curve));
}

function showSpace(viewer) {
  if (!geometry || geometry.cameras.length === 0) return;
  const choose = (name) => {
    const index = summary.images.findIndex((image) => image.name === name);
    if (viewer?.show(index)) viewer.element.scrollIntoView({block: "center"});
  };
  const points = geometry.points;
  const legend = el("div", {className: "legend"}, el("span", {className: "dot"}, el("i"), "training cameras"),
    el("span", {className: "dot second"}, el("i"), "held-out cameras"));
  const thinned = points && points.n < points.n_total ? ` (${format.count(points.n)} shown)` : "";
  addSection("cameras", "Cameras",
    `${plural(geometry.cameras.length, "camera")}${points ? ` and ${format.count(points.n_total)} sparse points${thinned}` : ""}. ` +
    "Drag to turn, pinch or use the buttons to zoom, click a held-out camera to see its view.", legend, makeSpace(geometry, choose));
}

function showCertificate() {
  if (!certificate) return;
  addSection("certainty", "How well the cameras are known", `${certificateLead(certificate)} ` +
    "Taken from how well the points that photos share fit together; a mistake that all photos agree on does not show in it.", ...makeCertificate(certificate));
}

const VERDICTS = {kept: "kept", repeated: "the same as a neighbour", blurred: "blurred", near: "near a kept frame"};

function showVideos() {
  if (!videos || videos.length === 0) return;
  const children = videos.flatMap(({name, n_frames: nFrames, verdicts, thumbnails}) => {
    const left = ["repeated", "blurred", "near"].filter((verdict) => verdicts[verdict] > 0)
      .map((verdict) => `${format.count(verdicts[verdict])} ${VERDICTS[verdict]}`);
    const strip = thumbnails.filter(({picture}) => picture).map(({picture, seconds, verdict}) => {
      const time = isNumber(seconds) ? `${format.fixed(seconds, 1)} s` : "";
      return el("figure", {className: verdict}, el("img", {src: picture, alt: `frame at ${time}, ${VERDICTS[verdict]}`, title: VERDICTS[verdict]}),
        el("figcaption", {}, time, el("span", {className: `pill${verdict === "kept" ? " yes" : ""}`}, verdict)));
    });
    return [el("p", {}, el("strong", {}, name), `: ${format.count(verdicts.kept)} of ${plural(nFrames, "frame")} kept${left.length > 0 ? `; left out: ${left.join(", ")}` : ""}.`),
      el("div", {className: "strip"}, ...strip)];
  });
  addSection("videos", "Frames from video",
    "Frames are taken as far apart as the picture moves, the sharpest of each stretch. Shown are some of both kinds, in their order.", ...children);
}

function showStages() {
  const {stages, failure} = summary;
  const failed = (stage) => stage.name === failure?.stage;
  const rows = !failure || stages.some(failed) ? stages : [...stages, {name: failure.stage, seconds: null, peak_memory_bytes: null}];
  if (rows.length === 0) return;
  const longest = Math.max(...rows.map((stage) => stage.seconds), 1e-9);
  const state = (stage) => (failed(stage) ? "failed" : stage.reused ? "reused" : "made");
  const tone = {failed: "bad", made: "yes", reused: ""};
  const columns = [
    {label: "Stage", value: (stage) => stage.name},
    {label: "Time", number: true, value: (stage) => stage.seconds, cell: (stage) => el("span", {}, format.seconds(stage.seconds),
      el("span", {className: "bar"}, el("i", {style: `width: ${100 * stage.seconds / longest}%`})))},
    {label: "Peak memory", number: true, value: (stage) => stage.peak_memory_bytes, cell: (stage) => format.bytes(stage.peak_memory_bytes)},
    {label: "Last run", value: state, cell: (stage) => el("span", {className: `pill ${tone[state(stage)]}`}, state(stage))},
  ];
  const host = summary.host;
  const where = host?.cpu ? ` On ${host.cpu}, ${plural(host.cores, "core")}, ${format.bytes(host.memory_bytes)} of memory.` : "";
  addSection("stages", "Stages", `Time and memory of what made this result, whichever run it was made in.${where}`,
    makeTable(columns, rows).element);
}

function showDecisions() {
  if (summary.decisions.length === 0) return;
  const columns = [
    {label: "Feature", value: (decision) => words(decision.feature)},
    {label: "Decision", value: (decision) => (decision.needed ? "used" : "left out"),
      cell: (decision) => el("span", {className: `pill${decision.needed ? " yes" : ""}`}, decision.needed ? "used" : "left out")},
    {label: "Evidence", value: (decision) => decision.evidence},
    {label: "Threshold", value: (decision) => decision.threshold},
    {label: "Reason", value: (decision) => decision.reason},
  ];
  addSection("decisions", "Decisions", "What this capture needs and what it does not, as measured.",
    makeTable(columns, summary.decisions, {stack: true, sortable: false}).element);
}

function showStability() {
  if (!stability) return;
  const details = el("details", {className: "more"}, el("summary", {}, stabilityLead(stability)),
    el("p", {className: "hint"}, STABILITY_HINT), makeStabilityTable(stability));
  details.open = stability.n_exceeded > 0;
  addSection("stability", "Numerical stability", "Errors of this program's numerics on stiff and extreme cases, measured on this machine.", details);
}

function showDetails() {
  const more = (title, content) => el("details", {className: "more"}, el("summary", {}, title), content);
  const children = [];
  if (summary.protocol) {
    const {images, ...protocol} = summary.protocol;
    children.push(more("How the figures were made", pairs({...protocol, ...(images ? {images} : {})})));
  }
  if (summary.settings.training) children.push(more("Training settings", pairs(summary.settings.training)));
  if (Object.keys(summary.settings.options).length > 0) children.push(more("Options given", pairs(summary.settings.options)));
  for (const {name} of summary.stages) {
    const {curve, settings, protocol, ...rest} = facts[name];  // those have their own places
    if (Object.keys(rest).length > 0) children.push(more(`Measured by ${name}`, pairs(rest)));
  }
  children.push(more("Versions", pairs(summary.versions)));
  addSection("details", "Details", "Everything needed to repeat and to compare.", ...children);
}

showStatus();
showTiles();
showWarnings();
const viewer = showImages();
showTraining();
showSpace(viewer);
showCertificate();
showVideos();
showStages();
showDecisions();
showStability();
showDetails();
byId("footer").textContent = `nrff ${summary.versions.nrff}. The same figures for programs: summary.json.`;
