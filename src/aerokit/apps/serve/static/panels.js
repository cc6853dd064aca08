// The panels: mission, parameters, texts and events, orders.

import { clock, element, number, SEVERITIES, shortest, show, spelled, unbroken, UNKNOWN, unitOf } from "./dom.js";
import { inWords } from "./readiness.js";
import { ask } from "./server.js";

export class MissionPanel {
  // upload: called with a File
  constructor(changed, upload) {
    this.changed = changed;
    this.missions = new Map();
    this.fences = new Map();
    this.reloadedFor = new Map(); // the states for which missions were read again
    this.body = element("tbody", {});
    this.note = element("span", { class: "note" });
    const load = element("button", { type: "button", onclick: () => this.load(this.vehicle, true) }, "Read from vehicle");
    const file = element("input", { type: "file", accept: ".plan,.json,.waypoints,.txt", hidden: true, onchange: () => { if (file.files[0]) upload(file.files[0]); file.value = ""; } });
    const choose = element("button", { type: "button", onclick: () => file.click() }, "Upload a plan …");
    this.node = element("div", {}, element("div", { class: "bar" }, choose, load, file), this.note,
      element("p", { class: "note" }, "A .plan or .waypoints file. You can also drop it anywhere on this page."), element("table", {}, this.body));
  }

  // {polygons, circles, rally} of a vehicle
  fence(id) { return this.fences.get(id) || { polygons: [], circles: [], rally: [] }; }

  async loadFence(id, query) {
    const read = (what) => ask("GET", `api/vehicles/${id}/${what}${query}`).catch(() => ({ polygons: [], circles: [], items: [] }));
    const fence = await read("fence"), rally = await read("rally");
    this.fences.set(id, { ...fence, rally: rally.items.map((each) => each.position).filter(Boolean) });
    this.changed();
  }

  // Reads the mission again from the server, which reads it from the vehicle if it has changed.
  reload(id) {
    this.missions.delete(id);
    this.load(id);
  }

  items(id) { return (this.missions.get(id) || { items: [] }).items; }

  async load(id, refresh = false) {
    if (id === undefined || (!refresh && this.missions.has(id))) return;
    this.missions.set(id, { items: [], note: "reading …" });
    const query = refresh ? "?refresh=true" : "";
    try {
      const found = await ask("GET", `api/vehicles/${id}/mission${query}`);
      const what = found.items.length ? `${found.items.length} items` : "the vehicle has no mission";
      this.missions.set(id, { items: found.items, note: `${what}, read at ${clock(Date.now() / 1000 - found.age_s)}`, version: found.version });
    } catch (error) {
      this.missions.set(id, { items: [], note: `reading failed: ${error.message}` });
    }
    this.drawn = undefined;
    this.changed();
    await this.loadFence(id, query);
  }

  // Reads the mission again, once, when the server knows of another number of items or another version of the mission.
  reloadIfChanged(vehicle, { items, version }) {
    const id = vehicle.system_id, { mission_items: count, mission_version: newest } = vehicle, state = `${count} ${newest}`;
    if (!version || this.reloadedFor.get(id) === state) return;
    const isNewer = newest[0] > version[0] || (newest[0] === version[0] && newest[1] !== version[1]);
    if (!isNewer && (count ?? items.length) === items.length) return;
    this.reloadedFor.set(id, state);
    this.reload(id);
  }

  show(vehicle) {
    if (!vehicle) return;
    this.vehicle = vehicle.system_id;
    const current = currentItem(vehicle), mission = this.missions.get(this.vehicle) || { items: [], note: "not read yet" };
    this.reloadIfChanged(vehicle, mission);
    show(this.note, mission.note);
    const drawn = [this.vehicle, current, mission.note].join("|");
    if (this.drawn === drawn) return;
    this.drawn = drawn;
    this.body.replaceChildren(...mission.items.map((item) => {
      const place = item.position ? `${item.position.latitude_deg.toFixed(6)}, ${item.position.longitude_deg.toFixed(6)}` : "";
      const height = item.position || item.z ? number(item.z, 1, "m") : itemValue(item);
      const name = spelled(item.name.replace(/^(NAV|DO)_/, ""));
      return element("tr", item.index === current ? { class: "current" } : {},
        element("td", { class: "number" }, String(item.index)), element("td", {}, name),
        element("td", { class: "name" }, place), element("td", { class: "number" }, height));
    }));
  }
}

// Numbered like the mission. The state mission_current counts home too, if the autopilot does.
export const currentItem = (vehicle) => vehicle.mission_item ?? null;

// The value of an item without a place: -1 and -2 stand for "unchanged" and "the vehicle's own".
function itemValue({ name, param1, param2, param3 }) {
  if (name === "DO_CHANGE_SPEED") return [param2 > 0 ? number(param2, 1, "m/s") : "", param3 > 0 ? number(param3, 0, "%") : ""].filter(Boolean).join(" · ");
  return ["NAV_DELAY", "CONDITION_DELAY"].includes(name) && param1 > 0 ? number(param1, 0, "s") : "";
}

export class ParameterPanel {
  constructor(setParameter, isSettable) {
    this.setParameter = setParameter;
    this.isSettable = isSettable;
    this.rows = [];
    this.tables = new Map();
    this.body = element("tbody", {});
    this.note = element("p", { class: "note" });
    this.search = element("input", { type: "search", placeholder: "Search names and descriptions …", autocomplete: "off", spellcheck: false, oninput: () => this.filter() });
    this.search.setAttribute("aria-label", "Search parameters");
    const load = element("button", { type: "button", onclick: () => this.load(this.vehicle, true) }, "Read");
    this.node = element("div", {}, element("div", { class: "bar" }, this.search, load), this.note, element("table", { class: "parameters" }, this.body));
  }

  async load(id, refresh = false) {
    if (id === undefined || (!refresh && this.tables.has(id))) return;
    this.tables.set(id, { rows: [], note: "reading all parameters …" });
    this.draw();
    try {
      const found = await ask("GET", `api/vehicles/${id}/parameters${refresh ? "?refresh=true" : ""}`);
      this.tables.set(id, { rows: found.parameters, receivedAt: Date.now() / 1000 });
    } catch (error) {
      this.tables.set(id, { rows: [], note: `reading failed: ${error.message}` });
    }
    this.draw();
  }

  changed(id, name, value) {
    const row = (this.tables.get(id) || { rows: [] }).rows.find((each) => each.name === name);
    if (row) Object.assign(row, { value, meaning: undefined }); // the server has the meaning of the value that it sent
    if (row && id === this.vehicle) this.draw();
  }

  show(vehicle) {
    if (this.node.classList.contains("settable") !== this.isSettable()) this.filter();
    if (!vehicle || vehicle.system_id === this.vehicle) return;
    this.vehicle = vehicle.system_id;
    this.load(this.vehicle);
    this.draw();
  }

  draw() {
    const table = this.tables.get(this.vehicle) || { rows: [], note: "" };
    this.rows = table.rows.map((each) => {
      const about = each.short_description || each.description;
      const name = element("button", { type: "button", class: "link", title: "Set …" }, each.name);
      const facts = [changedFrom(each), range(each)].filter(Boolean).join(" · ");
      const node = element("tr", { class: "clickable", onclick: () => this.setParameter(this.vehicle, each) },
        element("td", {}, name, each.other_names?.length ? element("div", { class: "detail" }, `other versions: ${each.other_names.join(", ")}`) : null, about ? element("div", { class: "detail" }, about) : null),
        element("td", { class: "number" }, withUnit(each, each.value), element("div", { class: "detail" }, meaning(each) || facts, meaning(each) && facts ? ` · ${facts}` : "")));
      const names = [each.name, ...(each.other_names ?? [])].join(" ");
      return { node, name: each.name, text: `${names} ${about ?? ""} ${each.description ?? ""}`.toUpperCase() };
    });
    this.body.replaceChildren(...this.rows.map((each) => each.node));
    this.filter();
  }

  filter() {
    const words = this.search.value.trim().toUpperCase().split(/\s+/);
    let count = 0;
    this.node.classList.toggle("settable", this.isSettable());
    for (const { node, text } of this.rows) {
      node.hidden = !words.every((word) => text.includes(word));
      count += !node.hidden;
    }
    const { note, receivedAt } = this.tables.get(this.vehicle) || {};
    const near = !count && words.length === 1 ? nearName(words[0], this.rows.map((each) => each.name)) : "";
    show(this.note, note ?? `${count} of ${this.rows.length} parameters, received at ${clock(receivedAt)}${near ? `: did you mean ${near}?` : count && this.isSettable() ? " · click one to set it" : ""}`);
  }
}

const MAX_EDITS = 2;

// The name with the fewest differences from a misspelt one; "" if all differ in more than two places.
function nearName(word, names) {
  const ranked = names.map((name) => [edits(word, name), name]).sort(([a, one], [b, other]) => a - b || one.localeCompare(other));
  const [[count, name] = [Infinity, ""]] = ranked;
  return count <= Math.min(MAX_EDITS, word.length / 3) ? name : "";
}

// How many characters must be added, removed or replaced to turn a word into a name (Levenshtein).
function edits(word, name) {
  if (name.length < word.length - MAX_EDITS) return Infinity;
  let row = Array.from({ length: name.length + 1 }, (_, column) => column);
  for (let line = 1; line <= word.length; line++) {
    const next = [line];
    for (let column = 1; column <= name.length; column++) {
      const replaced = row[column - 1] + (word[line - 1] === name[column - 1] ? 0 : 1);
      next.push(Math.min(replaced, row[column] + 1, next[column - 1] + 1));
    }
    row = next;
  }
  return row[name.length];
}

export const short = (value) => (value === null || value === undefined ? UNKNOWN : shortest(value));
const withUnit = (each, value) => `${short(value)}${each.unit ? ` ${each.unit}` : ""}`;
const meaning = (each) => (each.meaning && each.meaning !== withUnit(each, each.value) ? each.meaning : "");
const isKnown = (value) => value !== null && value !== undefined;
const bound = (limit) => (isKnown(limit) ? short(limit) : "");

function changedFrom(each) {
  return isKnown(each.default) && each.default !== each.value ? `default ${short(each.default)}` : "";
}

function range(each) {
  if (!isKnown(each.minimum) && !isKnown(each.maximum)) return "";
  return `${bound(each.minimum)} … ${bound(each.maximum)}`;
}

const MAX_REAL32 = 3.4028234663852886e38;

// The smallest and the largest number of an integer type; undefined for other types.
function integerLimits(type) {
  const [, sign, bits] = /^(U?)INT(8|16|32|64)$/.exec(type) ?? [];
  if (!bits) return undefined;
  const size = 2 ** (bits - (sign ? 0 : 1));
  return [sign ? 0 : -size, size - 1];
}

// Why the type of a parameter cannot hold a value, like checked_value in parameter.py; "" if it can.
export function typeProblem({ name, type }, value) {
  const limits = integerLimits(type);
  if (!limits) return type === "REAL32" && Math.abs(value) > MAX_REAL32 ? `${name} = ${value} is too large (it is a REAL32).` : "";
  const [minimum, maximum] = limits;
  if (!Number.isInteger(value)) return `${name} = ${value} must be a whole number (its type is ${type}).`;
  return value < minimum || value > maximum ? `${name} = ${value} must be in ${minimum}..${maximum} (its type is ${type}).` : "";
}

// Why the metadata does not allow a value, like ParameterMetadata.problem in metadata.py; "" if it does.
export function parameterProblem(each, value) {
  if (each.read_only) return `${each.name} can only be read`;
  const names = Object.entries(each.values ?? {}), hasRange = isKnown(each.minimum) || isKnown(each.maximum);
  const isInside = (!isKnown(each.minimum) || value >= each.minimum) && (!isKnown(each.maximum) || value <= each.maximum);
  if (names.some(([code]) => Number(code) === value) || (isInside && (hasRange || !names.length || each.has_bits))) return "";
  if (!hasRange) return `${each.name} = ${short(value)} is not a documented value: ${names.map((one) => one.join(" ")).join(", ")}`;
  return `${each.name} = ${short(value)} is not in ${bound(each.minimum)}..${bound(each.maximum)} ${each.unit ?? ""}`.trimEnd();
}

function typeText(type) {
  const limits = integerLimits(type);
  return limits ? `Whole numbers ${limits.join(" … ")} (${type}).` : `Numbers with fractions (${type}).`;
}

// What is known about a parameter, one line each, for the dialog that sets it.
export function aboutParameter(each) {
  return [
    each.description || each.short_description,
    range(each) ? `Range: ${range(each)} ${each.unit ?? ""}` : typeText(each.type),
    isKnown(each.default) ? `Default: ${withUnit(each, each.default)}` : "",
    each.reboot_required ? "Takes effect after a reboot." : "",
  ].filter(Boolean);
}

const MAX_TEXTS = 300;

export class TextPanel {
  constructor() {
    this.node = element("div", {});
    this.entries = [];
    this.numbers = new Set();
  }

  add(event) {
    if (this.numbers.has(event.number)) return;
    this.numbers.add(event.number);
    this.drawn = undefined;
    const last = this.entries.at(-1);
    if (event.event === "StreamSlow" && last?.event === "StreamSlow" && last.system_id === event.system_id) {
      if (!last.message.includes(event.message)) last.message += `, ${event.message}`;
      return;
    }
    this.entries.push(event);
    if (this.entries.length > MAX_TEXTS) this.numbers.delete(this.entries.shift().number);
  }

  show(vehicle) {
    const id = vehicle ? vehicle.system_id : 0;
    if (this.drawn === id) return;
    this.drawn = id;
    const shown = this.entries.filter((each) => (each.system_id === 0 || each.system_id === id) && describe(each)).reverse();
    this.node.replaceChildren(...shown.map((each) => {
      const severity = each.event === "StatusTextReceived" ? each.severity : 8;
      const kind = severity <= 3 ? "severe" : severity === 4 ? "warning" : severity === 8 ? "note" : "";
      const title = SEVERITIES[severity] || "event";
      return element("div", { class: "text", title }, element("time", {}, clock(each.time_unix_s)), element("span", { class: kind }, describe(each)));
    }));
    if (!shown.length) this.node.replaceChildren(element("p", { class: "note" }, "no messages yet"));
  }
}

const seconds = (value) => `${number(value, value < 10 ? 1 : 0)} s`;
const LANDED = { ON_GROUND: "On the ground", IN_AIR: "In the air", TAKEOFF: "Taking off", LANDING: "Landing" };

// ArduPilot announces each mission item in texts that repeat the events of the mission, as in supervised_flight.py.
const ITEM_TEXT = /^(Mission: \d+ |Reached command #\d+)/;

// Sentences for events; others list their fields.
const EVENT_TEXTS = {
  StatusTextReceived: (e) => (ITEM_TEXT.test(e.text) ? "" : e.text),
  ArmedChanged: (e) => (e.is_armed ? "Armed" : "Disarmed"),
  ModeChanged: (e) => (e.before === null ? `Mode ${e.after}` : `Mode ${e.before} → ${e.after}`),
  LandedStateChanged: (e) => LANDED[e.after] ?? "Unknown whether it has landed",
  LinkStateChanged: (e) => (e.after === "LOST" ? "Link lost" : ""), // VehicleSilent and VehicleRecovered say the rest
  VehicleFound: () => "Vehicle found",
  VehicleSilent: (e) => `Link silent for ${seconds(e.silent_for_s)}`,
  VehicleRecovered: (e) => `Link is back after ${seconds(e.silent_for_s)}`,
  VehicleRebooted: () => "The vehicle has rebooted",
  MissionItemReached: (e) => `Reached item ${e.item} of its mission`,
  MissionCurrentChanged: (e) => (e.after === null ? "No current mission item" : `Flies to item ${e.after} of its mission`),
  MissionFinished: () => "All items of the mission are done",
  ParameterChanged: (e) => `${e.name} changed from ${short(e.before)} to ${short(e.after)}`,
  StreamSlow: (e) => `Arrives at less than half the requested rate: ${e.message}`,
  LoopBlocked: (e) => `The server was busy for ${seconds(e.seconds)}`,
  StreamUnavailable: (e) => `The vehicle does not send ${e.message}: ${e.reason}`,
  DuplicateSender: () => "Another sender uses the same system id; it is ignored",
};

function describe(event) {
  if (EVENT_TEXTS[event.event]) return EVENT_TEXTS[event.event](event);
  const hidden = new Set(["type", "event", "number", "at", "system_id", "time_unix_s", "missed"]);
  if ("after" in event) hidden.add("before");
  const fields = Object.entries(event).filter(([name]) => !hidden.has(name)).map(([name, value]) => eventField(event, name, value));
  return [event.event.replace(/([a-z])([A-Z])/g, (_, a, b) => `${a} ${b.toLowerCase()}`), fields.join(", ")].filter(Boolean).join(": ");
}

// The same text as event_details in event_text.py.
function eventField(event, name, value) {
  const text = value === null ? "unknown" : typeof value === "object" ? JSON.stringify(value) : String(value);
  if (name === "after") return (event.before ?? null) === null ? text : `${event.before} → ${text}`;
  if (typeof value === "boolean") return `${value ? "" : "not "}${name.replace(/^is_/, "").replaceAll("_", " ")}`;
  if (["name", "message", "link", "peer", "text", "error"].includes(name)) return text;
  const { label, unit } = unitOf(name);
  return `${label.replace(/ id$/, "")} ${text}${unit ? ` ${unit}` : ""}`;
}

export class OrderPanel {
  constructor() {
    this.node = element("div", {});
    this.records = new Map();
  }

  record(order) {
    this.records.set(order.key, order);
    if (this.records.size > 100) this.records.delete(this.records.keys().next().value);
    this.drawn = undefined;
  }

  // The running orders of a vehicle, the newest last.
  running(id) {
    return [...this.records.values()].filter((each) => each.state === "running" && each.system_id === id);
  }

  // The vehicle finished its mission: the last order that started or resumed it says so.
  finishMission(id, unixSeconds) {
    const isBefore = (each) => each.system_id === id && /^mission\/(start|resume)$/.test(each.order) && each.given_unix_s <= unixSeconds;
    const order = [...this.records.values()].filter(isBefore).pop();
    if (order) order.finishedAt ??= unixSeconds;
    this.drawn = undefined;
  }

  // An order and its state, in words.
  outcome(record) {
    if (record.finishedAt) return `${outcome(record)}, all items done at ${clock(record.finishedAt)}`;
    if (!record.replaced_by) return outcome(record);
    const newer = this.records.get(record.replaced_by);
    return `${orderText(record)}: replaced by ${newer ? orderTitle(newer) : "a newer order"}`;
  }

  show() {
    if (this.drawn) return;
    this.drawn = true;
    const shown = [...this.records.values()].reverse();
    this.node.replaceChildren(...shown.map((each) => element("div", { class: "text" },
      element("time", {}, ...times(each).map((text) => element("div", {}, text))),
      element("span", {}, `vehicle ${each.system_id}: `, element("span", { class: shownState(each) }, ...unbroken(this.outcome(each))),
        each.problem && !each.replaced_by ? element("div", { class: "detail" }, inWords(each.problem)) : null))));
    if (!shown.length) this.node.replaceChildren(element("p", { class: "note" }, "no orders yet"));
  }
}

// When an order was given and when it reached its end, which may be the same second.
const times = (record) => [...new Set([record.given_unix_s, record.ended_unix_s].filter(Boolean).map(clock))].map((text, index) => (index ? `– ${text}` : text));

// An order that the next one replaced has not failed.
export const shownState = (record) => (record.replaced_by ? "replaced" : record.state);

// Text after the name of an order; other orders list their arguments.
const ORDER_TEXTS = {
  "mission/start": ({ item }) => ` at item ${item ?? 0}`,
  take_off: ({ altitude_m }) => ` to ${+altitude_m.toFixed(2)} m`,
  mode: ({ mode }) => ` ${mode}`,
  "mission/upload": ({ name, mission_items }) => ` ${name} (${mission_items} items)`,
  set_parameter: ({ name, value }) => ` ${name} to ${shortest(value)}`,
};

// Done when the vehicle reports its hold mode. PX4 then still moves.
const holds = (title) => (_, result) => `${title}: in ${result?.mode ?? "its hold mode"}, may still be stopping`;

// Orders that only begin something: "done" would read like its end.
const BEGUN = {
  "mission/start": ({ item }) => `mission started at item ${item ?? 0}`,
  "mission/resume": () => "mission resumed",
  hold: holds("hold"),
  "mission/pause": holds("mission pause"),
};

function outcome(record) {
  const text = record.state === "done" && BEGUN[record.order];
  if (text) return text(record.arguments, record.result);
  const note = record.order === "set_parameter" && record.result?.note;
  return `${orderText(record)}: ${record.state === "running" ? "ordered" : record.state}${note ? `; ${note}` : ""}`;
}

// An order as a reason or an effect of another one: without the place of "go to".
export function orderTitle(record) {
  const height = record.arguments.altitude_relative_m;
  return record.order === "go_to" ? `go to a position${typeof height === "number" ? ` at ${+height.toFixed(2)} m` : ""}` : orderText(record);
}

function orderText(record) {
  const name = record.order.replace("mission/upload", "upload").replace(/[_/]/g, " ").replace("set parameter", "set"), text = ORDER_TEXTS[record.order];
  if (text) return name + text(record.arguments);
  const given = Object.entries(record.arguments).map(([each, value]) => {
    const { label, unit } = unitOf(each);
    return `${label} ${typeof value === "number" ? +value.toFixed(6) : value}${unit ? ` ${unit}` : ""}`;
  });
  return [name, given.join(", ")].filter(Boolean).join(": ");
}
