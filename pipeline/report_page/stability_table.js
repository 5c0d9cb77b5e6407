// One row per case; a bar shows how much of its bound an error takes.
function makeStabilityTable(result) {
  const superscript = (power) => power.replace("+", "").replace(/[-0-9]/g, (c) => (c === "-" ? "⁻" : "⁰¹²³⁴⁵⁶⁷⁸⁹"[Number(c)]));
  const shown = (value) => { const [digits, power] = value.toExponential(1).split("e"); return `${digits}·10${superscript(power)}`; };
  const exceeded = (row) => !isNumber(row.error) || row.error > row.bound;
  const number = (value) => (isNumber(value) ? (value === 0 ? "0" : shown(value)) : "no number");
  const share = (row) => (exceeded(row) ? 1 : row.bound > 0 ? row.error / row.bound : 0);
  return makeTable([
    {label: "Part", value: (row) => row.part},
    {label: "Case", value: (row) => row.name},
    {label: "Condition", value: (row) => row.condition},
    {label: "Error", number: true, value: (row) => row.error, cell: (row) => number(row.error)},
    {label: "Bound", number: true, value: (row) => row.bound, cell: (row) => number(row.bound)},
    {label: "Of it", number: true, value: share, cell: (row) => (exceeded(row) ? el("span", {className: "pill bad"}, "exceeded")
      : el("span", {className: "bar"}, el("i", {style: `width: ${100 * Math.max(0, 1 + Math.log10(share(row)) / 6)}%`})))},
  ], result.cases, {stack: true}).element;
}

const stabilityLead = (result) => [`${result.cases.length} cases`,
  result.n_exceeded === 0 ? "all within their bounds" : `${result.n_exceeded} beyond their bounds`,
  `nrff ${result.version}`, result.host?.cpu, result.date].filter(Boolean).join(" · ");
const STABILITY_HINT = "The error is the largest one met, or that with the least margin where bounds differ. The bound follows from the " +
  "number format; the last column shows how much of it the error takes, on a logarithmic scale: empty is a millionth or less.";
