// One row per case; a bar shows how much of its bound an error takes.
const superscript = (power) => power.replace("+", "").replace(/[-0-9]/g, (c) => (c === "-" ? "⁻" : "⁰¹²³⁴⁵⁶⁷⁸⁹"[Number(c)]));
const shown = (value) => { const [digits, power] = value.toExponential(1).split("e"); return `${digits}·10${superscript(power)}`; };
const exceeded = (row) => !isNumber(row.error) || row.error > row.bound;
const number = (value) => (isNumber(value) ? (value === 0 ? "0" : shown(value)) : "no number");
const share = (row) => (exceeded(row) ? 1 : row.bound > 0 ? row.error / row.bound : 0);
byId("lead").textContent = [`${DATA.cases.length} cases`, DATA.n_exceeded === 0 ? "all within their bounds" : `${DATA.n_exceeded} beyond their bounds`,
  `nrff ${DATA.version}`, DATA.host?.cpu, DATA.date].filter(Boolean).join(" · ");
byId("cases").append(makeTable([
  {label: "Part", value: (row) => row.part},
  {label: "Case", value: (row) => row.name},
  {label: "Condition", value: (row) => row.condition},
  {label: "Error", number: true, value: (row) => row.error, cell: (row) => number(row.error)},
  {label: "Bound", number: true, value: (row) => row.bound, cell: (row) => number(row.bound)},
  {label: "Of it", number: true, value: share, cell: (row) => (exceeded(row) ? el("span", {className: "pill bad"}, "exceeded")
    : el("span", {className: "bar"}, el("i", {style: `width: ${100 * Math.max(0, 1 + Math.log10(share(row)) / 6)}%`})))},
], DATA.cases, {stack: true}).element);
