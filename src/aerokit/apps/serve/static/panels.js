// The panels: mission, parameters, texts and events, orders.

import { clock, element, number, show, UNKNOWN, unitOf } from "./dom.js";
import { ask } from "./server.js";

export class MissionPanel {
  constructor(changed) {
    this.changed = changed;
    this.missions = new Map();
    this.counts = new Map();
    this.body = element("tbody", {});
    this.note = element("span", { class: "note" });
    const load = element("button", { type: "button", onclick: () => this.load(this.vehicle, true) }, "Read from vehicle");
    this.node = element("div", {}, element("div", { class: "bar" }, load, this.note), element("table", {}, this.body));
  }

  items(id) { return (this.missions.get(id) || { items: [] }).items; }

  async load(id, refresh = false) {
    if (id === undefined || (!refresh && this.missions.has(id))) return;
    this.missions.set(id, { items: [], note: "reading …" });
    try {
      const found = await ask("GET", `api/vehicles/${id}/mission${refresh ? "?refresh=true" : ""}`);
      const what = found.items.length ? `${found.items.length} items` : "the vehicle has no mission";
      this.missions.set(id, { items: found.items, note: `${what}, read at ${clock(Date.now() / 1000 - found.age_s)}`, isRead: true });
    } catch (error) {
      this.missions.set(id, { items: [], note: `reading failed: ${error.message}` });
    }
    this.drawn = undefined;
    this.changed();
  }

  // Reads the mission again, once, when the vehicle reports another number of items.
  reloadIfChanged(vehicle, mission) {
    const id = vehicle.system_id, count = vehicle.mission_items ?? null;
    if (!mission.isRead || count === null || count === mission.items.length || this.counts.get(id) === count) return;
    this.counts.set(id, count);
    this.missions.delete(id);
    this.load(id);
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
      const height = item.position || item.z ? number(item.z, 1, "m") : "";
      const name = item.name.replace(/^(NAV|DO)_/, "").replaceAll("_", " ").toLowerCase();
      return element("tr", item.index === current ? { class: "current" } : {},
        element("td", { class: "number" }, String(item.index)), element("td", {}, name),
        element("td", { class: "name" }, place), element("td", { class: "number" }, height));
    }));
  }
}

// Numbered like the mission. The state mission_current counts home too, if the autopilot does.
export const currentItem = (vehicle) => vehicle.mission_item ?? null;

const MAX_SHOWN = 400;

export class ParameterPanel {
  constructor(setParameter) {
    this.setParameter = setParameter;
    this.tables = new Map();
    this.body = element("tbody", {});
    this.note = element("span", { class: "note" });
    this.search = element("input", { type: "search", placeholder: "search …", autocomplete: "off", spellcheck: false, oninput: () => this.draw() });
    this.search.setAttribute("aria-label", "Search parameters");
    const load = element("button", { type: "button", onclick: () => this.load(this.vehicle, true) }, "Read");
    this.node = element("div", {}, element("div", { class: "bar" }, this.search, load), this.note, element("table", {}, this.body));
  }

  async load(id, refresh = false) {
    if (id === undefined || (!refresh && this.tables.has(id))) return;
    this.tables.set(id, { rows: [], note: "reading all parameters …" });
    this.draw();
    try {
      const found = await ask("GET", `api/vehicles/${id}/parameters${refresh ? "?refresh=true" : ""}`);
      this.tables.set(id, { rows: found.parameters });
    } catch (error) {
      this.tables.set(id, { rows: [], note: `reading failed: ${error.message}` });
    }
    this.draw();
  }

  changed(id, name, value) {
    const row = (this.tables.get(id) || { rows: [] }).rows.find((each) => each.name === name);
    if (row) row.value = value;
    if (row && id === this.vehicle) this.draw();
  }

  show(vehicle) {
    if (!vehicle || vehicle.system_id === this.vehicle) return;
    this.vehicle = vehicle.system_id;
    this.load(this.vehicle);
    this.draw();
  }

  draw() {
    const table = this.tables.get(this.vehicle) || { rows: [], note: "" };
    const wanted = this.search.value.trim().toUpperCase();
    const found = table.rows.filter((each) => each.name.toUpperCase().includes(wanted));
    show(this.note, table.note ?? `${found.length} of ${table.rows.length}${found.length > MAX_SHOWN ? `, showing the first ${MAX_SHOWN}` : ""}`);
    this.body.replaceChildren(...found.slice(0, MAX_SHOWN).map((each) => {
      const differs = each.default !== null && each.default !== each.value;
      return element("tr", { class: "clickable", title: "set …", onclick: () => this.setParameter(this.vehicle, each) },
        element("td", {}, each.name),
        element("td", { class: "number" }, each.value === null ? UNKNOWN : String(+each.value.toPrecision(7))),
        element("td", { class: "age" }, differs ? `default ${+each.default.toPrecision(7)}` : ""));
    }));
  }
}

const MAX_TEXTS = 300;
const SEVERITIES = ["emergency", "alert", "critical", "error", "warning", "notice", "info", "debug"];

export class TextPanel {
  constructor() {
    this.node = element("div", {});
    this.entries = [];
    this.numbers = new Set();
  }

  add(event) {
    if (this.numbers.has(event.number)) return;
    this.numbers.add(event.number);
    this.entries.push(event);
    if (this.entries.length > MAX_TEXTS) this.numbers.delete(this.entries.shift().number);
    this.drawn = undefined;
  }

  show(vehicle) {
    const id = vehicle ? vehicle.system_id : 0;
    if (this.drawn === id) return;
    this.drawn = id;
    const shown = this.entries.filter((each) => each.system_id === 0 || each.system_id === id).reverse();
    this.node.replaceChildren(...shown.map((each) => {
      const severity = each.event === "StatusTextReceived" ? each.severity : 8;
      const kind = severity <= 3 ? "severe" : severity === 4 ? "warning" : severity === 8 ? "note" : "";
      const title = SEVERITIES[severity] || "event";
      return element("div", { class: "text", title }, element("time", {}, clock(each.time_unix_s)), element("span", { class: kind }, describe(each)));
    }));
    if (!shown.length) this.node.replaceChildren(element("p", { class: "note" }, "no messages yet"));
  }
}

function describe(event) {
  if (event.event === "StatusTextReceived") return event.text;
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

  running(id, order) {
    return [...this.records.values()].filter((each) => each.state === "running" && each.system_id === id && each.order === order).pop();
  }

  show() {
    if (this.drawn) return;
    this.drawn = true;
    const shown = [...this.records.values()].reverse();
    this.node.replaceChildren(...shown.map((each) => element("div", { class: "text" },
      element("time", {}, clock(each.given_unix_s)),
      element("span", {}, `vehicle ${each.system_id}: ${orderText(each)}: `, element("b", { class: each.state }, each.state),
        each.problem ? element("div", { class: "detail" }, each.problem.detail) : null))));
    if (!shown.length) this.node.replaceChildren(element("p", { class: "note" }, "no orders yet"));
  }
}

// Text after the name of an order; other orders list their arguments.
const ORDER_TEXTS = {
  take_off: ({ altitude_m }) => ` to ${+altitude_m.toFixed(2)} m`,
  mode: ({ mode }) => ` ${mode}`,
  set_parameter: ({ name, value }) => ` ${name} to ${+value.toPrecision(7)}`,
};

export function orderText(record) {
  const name = record.order.replace(/[_/]/g, " ").replace("set parameter", "set"), text = ORDER_TEXTS[record.order];
  if (text) return name + text(record.arguments);
  const given = Object.entries(record.arguments).map(([each, value]) => {
    const { label, unit } = unitOf(each);
    return `${label} ${typeof value === "number" ? +value.toFixed(6) : value}${unit ? ` ${unit}` : ""}`;
  });
  return [name, given.join(", ")].filter(Boolean).join(": ");
}
