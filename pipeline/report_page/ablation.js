// A table per group of settings; what a part is worth is the difference to the group's best row.
byId("lead").textContent = [`preset ${DATA.preset}`, ...(isNumber(DATA.width) ? [`${DATA.width} × ${DATA.height} px`] : []), `${format.count(DATA.steps)} steps each`, `nrff ${DATA.version}`, DATA.host?.cpu, DATA.date].filter(Boolean).join(" · ");
byId("protocol").textContent = "Means over all held-out views, renders of 16 bits; seconds are of training alone. "
  + (DATA.seeds > 1 ? `${DATA.seeds} seeds, in brackets the least and the most. ` : "One seed: another one differs by some tenths of a dB. ")
  + "Bold: the model as it is.";

const loss = (value, best) => (isNumber(value) && isNumber(best) ? value - best : null);
const signed = (value) => (isNumber(value) ? (value === 0 ? "best" : value.toFixed(2).replace("-", "−")) : DASH);
for (const group of DATA.groups) {
  const best = Math.max(...group.rows.map((row) => row.psnr?.mean ?? -Infinity));
  const publishedBest = Math.max(...group.rows.map((row) => row.published ?? -Infinity));
  const worst = Math.min(...group.rows.map((row) => loss(row.psnr?.mean, best) ?? 0), -0.01);
  const scored = group.rows.some((row) => row.lpips);
  const published = (row) => (isNumber(row.published)
    ? el("span", {}, format.psnr(row.published), " ", el("span", {className: "small muted"}, signed(loss(row.published, publishedBest)))) : DASH);
  const bar = (value) => el("span", {className: "bar"}, el("i", {style: `width: ${100 * (isNumber(value) ? value / worst : 0)}%`}));
  byId("groups").append(el("section", {}, el("h2", {}, group.title), el("p", {className: "hint"}, `${group.note} Published: ${group.published}.`), makeTable([
    {label: "Model", value: (row) => row.label, cell: (row) => (row.own ? el("strong", {}, row.label) : row.label)},
    {label: "PSNR (dB)", number: true, value: (row) => row.psnr?.mean, cell: (row) => bandText(row.psnr, format.psnr)},
    {label: "To the best", number: true, value: (row) => loss(row.psnr?.mean, best), cell: (row) => el("span", {}, signed(loss(row.psnr?.mean, best)), bar(loss(row.psnr?.mean, best)))},
    {label: "SSIM", number: true, value: (row) => row.ssim?.mean, cell: (row) => bandText(row.ssim, format.ssim)},
    ...(scored ? [{label: "LPIPS", number: true, value: (row) => row.lpips?.mean, cell: (row) => bandText(row.lpips, format.ssim)}] : []),
    {label: "Parameters", number: true, value: (row) => row.n_parameters?.mean, cell: (row) => format.large(row.n_parameters?.mean)},
    {label: "Training", number: true, value: (row) => row.seconds?.mean, cell: (row) => bandText(row.seconds, format.seconds)},
    {label: "Per view", number: true, value: (row) => row.seconds_per_view?.mean, cell: (row) => (row.seconds_per_view ? `${row.seconds_per_view.mean.toPrecision(2)} s` : DASH)},
    {label: "Published (dB)", number: true, value: (row) => row.published, cell: published},
  ], group.rows, {stack: true}).element));
}
