// State of a vehicle, with ages: the main values, and a table of all states.

import { age, element, number, SEVERITIES, show, spelled, staleness, UNKNOWN, unitOf } from "./dom.js";

const REPORTED_ONCE = new Set(["home", "origin", "version", "capabilities", "status_text", "mission_reached", "mission_current"]);

// Current age of a value in seconds; it increases while nothing is received.
export const ageOf = (entry, receivedAt) =>
  entry && typeof entry.age_s === "number" ? entry.age_s + (performance.now() - receivedAt) / 1000 : undefined;

const first = (value) => (Array.isArray(value) ? value[0] : undefined);
const heading = (value) => number(value, 0, "°");

const BIG = [
  ["Mode", "mode", (value) => value.name],
  ["Motors", "armed", (value) => (value === true ? "ARMED" : value === false ? "disarmed" : UNKNOWN)],
  ["Above home", "position", (value) => number(value.altitude_relative_m, 1, "m")],
  ["Ground speed", "ground_speed_m_s", (value) => number(value, 1, "m/s")],
  ["Heading", "heading_deg", heading],
  ["Climb", "climb_m_s", (value) => number(value, 1, "m/s")],
  ["Battery", "batteries", (value) => battery(first(value))],
  ["Satellites", "gps", (value) => satellites(first(value))],
];

function battery(value) {
  if (!value) return UNKNOWN;
  return `${number(value.remaining_percent, 0, "%")} · ${number(value.voltage_v, 1, "V")}`;
}

function satellites(value) {
  if (!value) return UNKNOWN;
  const fix = String(value.fix_type ?? UNKNOWN).replace(/^TYPE_/, "").replaceAll("_", " ").replace("FIXED", "fixed").replace("FLOAT", "float");
  return `${number(value.satellites, 0)} · ${fix}`;
}

export class BigValues {
  constructor(list) {
    this.cells = BIG.map(([title]) => {
      const cell = element("dd", { class: "unknown" }, element("span", {}, UNKNOWN), element("small", {}));
      list.append(element("div", {}, element("dt", {}, title), cell));
      return cell;
    });
  }

  show(vehicle, receivedAt) {
    BIG.forEach(([, name, text], index) => {
      const entry = vehicle && vehicle.states[name];
      const known = entry && entry.value !== null && entry.value !== undefined;
      const shown = known ? text(entry.value) : UNKNOWN;
      const old = ageOf(entry, receivedAt);
      const kind = shown === UNKNOWN ? "unknown" : staleness(old) || (shown === "ARMED" ? "armed" : "");
      this.cells[index].className = kind;
      show(this.cells[index].children[0], shown);
      show(this.cells[index].children[1], kind === "old" ? `${age(old)} old` : "");
      this.cells[index].title = known ? `received ${age(old)} ago` : "unknown";
    });
  }
}

export class StateTable {
  constructor() {
    this.node = element("div", {});
    this.body = element("tbody", {});
    this.link = element("p", { class: "note" });
    const head = element("tr", {}, ...["State", "Value", "Age"].map((text, index) => element("th", index === 2 ? { class: "age" } : {}, text)));
    this.node.append(this.link, element("table", {}, element("thead", {}, head), this.body));
    this.rows = new Map();
  }

  show(vehicle, receivedAt) {
    if (vehicle !== undefined && this.vehicle !== vehicle.system_id) {
      this.vehicle = vehicle.system_id;
      this.rows.clear();
      this.body.replaceChildren();
    }
    if (!vehicle) return;
    const { link } = vehicle, total = link.frames_received + link.frames_lost;
    const lost = total ? `${(100 * link.frames_lost / total).toFixed(1)} % of ${total} frames lost` : "";
    show(this.link, `${vehicle.firmware} · link ${link.state ?? UNKNOWN} · ${lost}`);
    for (const [name, entry] of Object.entries(vehicle.states)) this.row(name, entry, receivedAt);
  }

  row(name, entry, receivedAt) {
    let cells = this.rows.get(name);
    if (!cells) {
      cells = [element("td", { class: "name" }, unitOf(name).label), element("td", { class: "value" }), element("td", { class: "age" })];
      this.rows.set(name, cells);
      const isLater = (each) => each.cells[0].textContent.localeCompare(cells[0].textContent) > 0;
      this.body.insertBefore(element("tr", {}, ...cells), [...this.body.rows].find(isLater) ?? null);
    }
    const old = ageOf(entry, receivedAt), kind = REPORTED_ONCE.has(name) ? "" : staleness(old);
    show(cells[1], inWords(name, entry.value), "value");
    show(cells[2], age(old), `age ${kind}`);
  }
}

// Names of bits by state, from the server.
export const bitNames = {};
// Redundant: other fields have it in words.
const RAW = new Set(["custom_mode", "base_mode", "present", "enabled", "capabilities", "number", "message", "at"]);

// Names of the bits of a value; bits without a name are numbered.
function bits(table, value) {
  const names = [];
  for (let bit = 0; bit < 32; bit++) {
    const mask = 2 ** bit;
    if (Math.floor(value / mask) % 2) names.push(table?.[mask] ? spelled(table[mask].replace(/^MAV_SYS_STATUS_/, "")) : `bit ${bit}`);
  }
  return names.join(", ") || "none";
}

function inWords(state, value) {
  if (state === "mode" && value) return value.name;
  if (state === "sensors" && value) return plain({ ...value, healthy: bits(bitNames.sensors, value.enabled & value.healthy) });
  if (state === "power" && value) return plain({ ...value, flags: bits(bitNames.power, value.flags) });
  if (state === "estimator" && value) return plain({ ...value, flags: bits(bitNames[value.message], value.flags) });
  if (state === "status_text" && value) return `${SEVERITIES[value.severity] ?? "text"}: ${value.text}`;
  if (state === "system_time" && value?.unix_s) return `${new Date(value.unix_s * 1000).toISOString().slice(0, 19)} UTC · ${number(value.since_boot_s, 0, "s")} since boot`;
  if (state === "mission_current" && value?.state === "NO_MISSION") return "no mission";
  return plain(value, unitOf(state));
}

function plain(value, { unit, digits } = { unit: "" }) {
  if (value === null || value === undefined) return UNKNOWN;
  if (typeof value === "number") return measured(value, unit, digits);
  if (Array.isArray(value)) return list(value, { unit, digits });
  if (typeof value === "object") {
    const shown = Object.entries(value).filter(([name, each]) => each !== null && !RAW.has(name));
    return shown.map(([name, each]) => `${unitOf(name).label} ${plain(each, unitOf(name))}`).join(" · ");
  }
  if (typeof value === "boolean") return value ? "yes" : "no";
  return /^[A-Z][A-Z0-9]*(_[A-Z0-9]+)*$/.test(value) ? spelled(value) : String(value);
}

function list(values, { unit, digits }) {
  if (!values.length) return "none";
  const isNumeric = values.every((each) => typeof each === "number");
  const text = values.map((each) => plain(each, { unit: isNumeric ? "" : unit, digits })).join(", ");
  return isNumeric && unit ? `${text} ${unit}` : text;
}

function measured(value, unit, digits) {
  if (digits !== undefined) return number(value, digits, unit);
  if (!Number.isInteger(value)) return number(value, Math.abs(value) < 1 ? 4 : 2, unit).replace(/(\.\d*?)0+(?!\d)/, "$1").replace(/\.(?!\d)/, "");
  return unit ? `${value} ${unit}` : String(value);
}
