// Elements and numbers. Texts of vehicles become text nodes, never HTML: no script sets innerHTML.

export function element(tag, properties = {}, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(properties)) {
    if (name.startsWith("on")) made.addEventListener(name.slice(2), value);
    else if (name === "class") made.className = value;
    else if (name in made && name !== "list") made[name] = value;
    else made.setAttribute(name, value);
  }
  made.append(...children.filter((child) => child !== null && child !== undefined));
  return made;
}

export const byId = (id) => document.getElementById(id);
export const UNKNOWN = "—";
export const SEVERITIES = ["emergency", "alert", "critical", "error", "warning", "notice", "info", "debug"]; // MAV_SEVERITY

export function number(value, digits = 1, unit = "") {
  if (typeof value !== "number" || !Number.isFinite(value)) return UNKNOWN;
  const text = value.toFixed(digits).replace(/^-(0(\.0+)?)$/, "$1");
  return unit ? `${text} ${unit}` : text;
}

// The shortest text of a number that is the same 32-bit float, as in which vehicles store and send fractions.
export function shortest(value) {
  if (Number.isInteger(value)) return String(value);
  const texts = [1, 2, 3, 4, 5, 6, 7, 8, 9].map((digits) => String(+value.toPrecision(digits)));
  return texts.find((text) => Math.fround(+text) === Math.fround(value)) ?? String(value);
}

// Suffix of a name, unit, digits, and label; longer suffixes first.
const UNITS = [
  ["_rate_deg_s", "°/s", 1, " rate"], ["_m_s2", "m/s²", 2], ["_m_s", "m/s", 2], ["_per_s", "/s"], ["_deg", "°", 1], ["_percent", "%"], ["_mah", "mAh"],
  ["_wh", "Wh", 1], ["_hz", "Hz", 1], ["_us", "µs"], ["_m", "m", 2], ["_v", "V", 2], ["_a", "A", 2], ["_c", "°C", 1], ["_s", "s", 1],
];

// Splits "north_m_s" into the label "north", the unit "m/s" and the number of digits.
export function unitOf(name) {
  const [ending, unit, digits, rest = ""] = UNITS.find(([each]) => name.endsWith(each)) ?? ["", "", undefined];
  const label = (name.slice(0, name.length - ending.length) + rest).replaceAll("_", " ");
  return { label, unit, digits: /itude_deg$/.test(name) ? 6 : digits };
}

export function age(seconds) {
  if (typeof seconds !== "number") return UNKNOWN;
  if (seconds < 1) return "now";
  if (seconds < 60) return `${seconds.toFixed(0)} s`;
  if (seconds < 3600) return `${(seconds / 60).toFixed(0)} min`;
  return `${(seconds / 3600).toFixed(1)} h`;
}

// Class of a value that is normally updated at least once a second, by its age.
export function staleness(seconds) {
  if (seconds === undefined || seconds === null) return "unknown";
  return seconds > 3 ? "old" : "";
}

// A name of an enumeration in lower case: "ON_GROUND" becomes "on ground".
export const spelled = (name) => ({ MC: "multicopter", FW: "fixed wing", TYPE_2D_FIX: "2D", TYPE_3D_FIX: "3D" })[name] ?? name.toLowerCase().replaceAll("_", " ");

export function clock(unixSeconds) {
  return new Date(unixSeconds * 1000).toLocaleTimeString([], { hour12: false });
}

// A text as nodes, in which no line breaks inside an option such as --metadata.
export const unbroken = (text) =>
  text.split(/(--[a-z][a-z-]*)/).map((part) => (part.startsWith("--") ? element("span", { class: "option" }, part) : part));

export function show(node, text, className) {
  if (node.textContent !== text) node.textContent = text;
  if (className !== undefined && node.className !== className) node.className = className;
}
