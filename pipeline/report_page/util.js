// What the pages share: making elements, writing figures, sortable tables. Text only ever enters through textContent
// and attributes, so that a photo's name cannot become markup.
const DATA = JSON.parse(document.getElementById("data").textContent);

const el = (tag, properties = {}, ...children) => {
  const element = document.createElement(tag);
  for (const [key, value] of Object.entries(properties)) {
    if (value === null || value === undefined) continue;
    if (key in element && key !== "style") element[key] = value;
    else element.setAttribute(key, value);
  }
  element.append(...children.filter((child) => child !== null && child !== undefined));
  return element;
};

const byId = (id) => document.getElementById(id);
const isNumber = (value) => typeof value === "number" && Number.isFinite(value);
const DASH = "–";

const format = {
  fixed: (value, digits) => (isNumber(value) ? value.toFixed(digits) : DASH),
  psnr: (value) => (isNumber(value) ? value.toFixed(2) : DASH),
  ssim: (value) => (isNumber(value) ? value.toFixed(4) : DASH),
  count: (value) => (isNumber(value) ? value.toLocaleString("en") : DASH),
  // 12.8 M
  large: (value) => {
    if (!isNumber(value)) return DASH;
    for (const [unit, size] of [["G", 1e9], ["M", 1e6], ["k", 1e4]]) {
      if (value >= size) return `${(value / (unit === "k" ? 1e3 : size)).toPrecision(3)} ${unit}`;
    }
    return value.toLocaleString("en");
  },
  seconds: (value) => {
    if (!isNumber(value)) return DASH;
    if (value < 10) return `${value.toFixed(1)} s`;
    const total = Math.round(value), minutes = Math.floor(total / 60);
    if (total < 60) return `${total} s`;
    if (minutes < 60) return `${minutes} min ${String(total % 60).padStart(2, "0")} s`;
    return `${Math.floor(minutes / 60)} h ${String(minutes % 60).padStart(2, "0")} min`;
  },
  bytes: (value) => {
    if (!isNumber(value)) return DASH;
    const units = ["B", "KiB", "MiB", "GiB", "TiB"];
    let scaled = value, unit = 0;
    while (scaled >= 1024 && unit + 1 < units.length) { scaled /= 1024; ++unit; }
    return `${unit === 0 ? scaled : scaled.toPrecision(scaled >= 1000 ? 4 : 3)} ${units[unit]}`;
  },
  // Anything a settings file may hold, as one line.
  any: (value) => {
    if (value === null || value === undefined) return DASH;
    if (Array.isArray(value)) return value.map(format.any).join(", ");
    if (typeof value === "object") return Object.entries(value).map(([key, v]) => `${words(key)} ${format.any(v)}`).join(", ");
    if (typeof value === "boolean") return value ? "yes" : "no";
    if (isNumber(value) && !Number.isInteger(value)) return String(Number(value.toPrecision(6)));
    return String(value);
  },
};

// {mean, least, most} as "mean (least to most)", or as one figure where they are equal.
const bandText = (band, show) => (!band ? DASH : band.least === band.most ? show(band.mean) : `${show(band.mean)} (${show(band.least)} to ${show(band.most)})`);

const words = (key) => key.replaceAll("_", " ");

// columns: {label, number, value(row): what is sorted by, cell(row): text or element; default the value as it is}.
// Sorting is stable; rows without a value come last. `options.sortable` false: as given. Returns {element, rows: Map of
// row → tr}.
function makeTable(columns, rows, options = {}) {
  const sortable = options.sortable !== false;
  const body = el("tbody"), lines = new Map();
  for (const row of rows) {
    const cells = columns.map((column) => {
      const content = column.cell ? column.cell(row) : column.value(row);
      const cell = el("td", {className: column.number ? "number" : "text"}, content);
      cell.dataset.label = column.label;
      return cell;
    });
    lines.set(row, el("tr", {}, ...cells));
  }
  const heads = columns.map((column, index) => {
    const head = el("th", {className: column.number ? "number" : "", scope: "col"});
    if (!sortable || column.label === "") {
      head.append(column.label);
      return head;
    }
    head.append(el("button", {type: "button", onclick: () => {
      const ascending = head.getAttribute("aria-sort") !== "ascending";
      for (const other of heads) other.removeAttribute("aria-sort");
      head.setAttribute("aria-sort", ascending ? "ascending" : "descending");
      sortBy(index, ascending);
    }}, column.label));
    return head;
  });
  const sortBy = (index, ascending) => {
    const {value, number} = columns[index];
    const compare = (a, b) => {
      const x = value(a), y = value(b);
      const missing = (x === null || x === undefined) - (y === null || y === undefined);
      if (missing !== 0 || x === null || x === undefined) return missing;
      const order = number ? x - y : String(x).localeCompare(String(y), "en", {numeric: true});
      return ascending ? order : -order;
    };
    body.append(...[...rows].sort(compare).map((row) => lines.get(row)));
  };
  body.append(...lines.values());
  const table = el("table", {className: options.stack ? "stack" : ""}, el("thead", {}, el("tr", {}, ...heads)), body);
  const element = el("div", {className: `table${options.long ? " long" : ""}`}, table);
  return {element, rows: lines};
}

// Calls draw(width) now and whenever the element's width changes.
function onWidth(element, draw) {
  let last = 0;
  const update = () => {
    const width = element.clientWidth;
    if (width > 0 && width !== last) draw(last = width);
  };
  new ResizeObserver(() => requestAnimationFrame(update)).observe(element);
  update();
}
