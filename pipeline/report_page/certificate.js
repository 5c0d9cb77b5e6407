// How well the photos fix the poses: a lead, figures, tracks by length, cameras from the weakest, photos left out.

const degrees = (value) => (isNumber(value) ? `${value < 0.001 ? value.toExponential(1) : value.toPrecision(2)}°` : DASH);
// A share as per cent, of two digits.
const share = (value) => (isNumber(value) ? `${value < 1e-5 ? (100 * value).toExponential(1) : Number((100 * value).toPrecision(2))} %` : DASH);
const middle = (values) => (values.length > 0 ? median(values) : NaN);

const sentence = (text) => text.charAt(0).toUpperCase() + text.slice(1);

// tracks: [{length, n}]; lengths from `kMost` on share a bar.
function trackBars(tracks) {
  const kMost = 12, kTallest = 110, bars = new Map();
  for (const {length, n} of tracks) bars.set(Math.min(length, kMost), (bars.get(Math.min(length, kMost)) ?? 0) + n);
  const most = Math.max(...bars.values()), total = [...bars.values()].reduce((sum, n) => sum + n, 0);
  return el("div", {className: "bars", role: "img", "aria-label": "Points by the number of photos that see them"},
    ...Array.from({length: kMost - 1}, (_, i) => i + 2).map((length) => {
      const n = bars.get(length) ?? 0;
      return el("div", {title: `${format.count(n)} points`},
        el("span", {}, n > 0 ? `${(100 * n / total).toFixed(n / total < 0.1 ? 1 : 0)} %` : ""),
        el("i", {style: `height: ${kTallest * n / most}px`}), el("b", {}, length === kMost ? `${kMost}+` : String(length)));
    }));
}

function certificateLead({cameras, components, degeneracy}) {
  if (cameras.length === 0) return degeneracy ? "The photos leave poses open, so that nothing can be said of single cameras." : "";
  const {name, position, rotation_deg: rotation} = cameras[0];
  const parts = [`Where poses, lenses and points fit together best, one standard deviation of a camera's place is ${share(middle(cameras.map((camera) => camera.position)))} of its distance ` +
    `to the scene's centre, of its direction ${degrees(middle(cameras.map((camera) => camera.rotation_deg)))} (medians). ` +
    `Least is known of ${name}: ${share(position)} and ${degrees(rotation)}.`];
  if (components.length > 1) parts.push(`The photos are ${components.length} groups that share no points: ${components.join(", ")}.`);
  return parts.join(" ");
}

// Elements; a notice comes first where something is open.
function makeCertificate(certificate) {
  const {error_px: error, converged, remaining, reason, degeneracy, structure, n_left_out: out, cameras, left_out: photos} = certificate;
  const px = (value) => `${format.fixed(value, 2)} px`;
  const children = [];
  if (degeneracy || structure.length > 0) {
    children.push(el("div", {className: "notice"}, el("strong", {}, "What these photos leave open"),
      degeneracy ? el("p", {}, `${sentence(degeneracy)}.`) : null,
      ...structure.filter((text) => !degeneracy?.includes(text)).map((text) => el("p", {}, `${sentence(text)}; lenses and poses are fixed nevertheless.`))));
  }
  const atMinimum = converged || /at its minimum/.test(reason ?? "");
  const tiles = el("dl", {className: "tiles"});
  const add = (label, value, note) => tiles.append(el("div", {className: "tile"}, el("dt", {}, label), el("dd", {}, value), el("p", {}, note)));
  add("Reprojection error", px(error.before.median), `median, with the poses in use; ${px(error.before.mean)} in the mean`);
  add("At the joint minimum", px(error.after.median), atMinimum
    ? `of poses, lenses and points together, which the deviations are of; converged${isNumber(remaining) ? `, ${Number(remaining.toPrecision(1))} standard deviations from it` : ""}`
    : sentence(reason ?? "not converged: the fit was stopped before"));
  const leftOut = [[out.points, "point", " seen by one photo"], [out.behind, "observation", " from behind"], [out.beyond_lens, "observation", " beyond the lens"]]
    .filter(([n]) => n > 0).map(([n, what, where]) => plural(n, what) + where);
  add("Points", format.large(certificate.n_points), `${format.large(certificate.n_observations)} observations, all in front of their cameras` +
    (leftOut.length > 0 ? ` but those left out: ${leftOut.join(", ")}` : ""));
  add("Connected", certificate.components.length === 1 ? "all" : `${certificate.components.length} groups`, certificate.components.length === 1
    ? `${plural(certificate.components[0], "photo")} tied together by common points` : `of ${certificate.components.join(", ")} photos, which share no points`);
  children.push(tiles);
  if (certificate.track_lengths.length > 0) {
    children.push(el("h3", {}, "Points by the number of photos that see them"), trackBars(certificate.track_lengths));
  }
  if (cameras.length > 0) {
    const most = Math.max(...cameras.map((camera) => camera.position), 1e-12);
    const isReference = (camera) => camera.position === 0 && camera.rotation_deg === 0;
    const bar = (camera) => el("span", {}, isReference(camera) ? "the others refer to it" : share(camera.position), el("span", {className: "bar"}, el("i", {style: `width: ${100 * camera.position / most}%`})));
    const columns = [
      {label: "Photo", value: (camera) => camera.name},
      {label: "Held out", value: (camera) => (camera.split === "test" ? "yes" : "")},
      {label: "Place (± of its distance)", number: true, value: (camera) => camera.position, cell: bar},
      {label: "Direction (±)", number: true, value: (camera) => camera.rotation_deg, cell: (camera) => (isReference(camera) ? "" : degrees(camera.rotation_deg))},
    ];
    children.push(el("h3", {}, "Cameras, least known first"), makeTable(columns, cameras, {long: true}).element);
  }
  if (photos.length > 0) {
    children.push(el("h3", {}, "Photos left out"), makeTable([{label: "Photo", value: (photo) => photo.name},
      {label: "Reason", value: (photo) => photo.reason}], photos, {stack: true, sortable: false}).element);
  }
  return children;
}
