// The page: stores the messages of the stream, and shows them.

import { drawAttitude } from "./attitude.js";
import { age, byId, element, number, show, unbroken } from "./dom.js";
import { MapView } from "./map.js";
import { Orders } from "./orders.js";
import { targetAltitude } from "./facts.js";
import { currentItem, MissionPanel, OrderPanel, ParameterPanel, shownState, TextPanel } from "./panels.js";
import { disarmText, failsafeTitle, inWords, isConnected, light, showCrashes, showReadiness, showSilences } from "./readiness.js";
import { ask, hasToken, openStream, useToken } from "./server.js";
import { ageOf, BigValues, bitNames, StateTable } from "./state.js";

const page = { vehicles: new Map(), selected: undefined, receivedAt: 0, atSeconds: null, isOpen: false, isReadOnly: false, modesOf: undefined };
const selected = () => page.vehicles.get(page.selected);

const map = new MapView(byId("map"), {
  picked: (place, y) => { pick(false); orders.goTo(place, targetAltitude(page.running(page.selected)) ?? heightNow(), y); }, chosen: (id) => { if (!previewed) choose(id); }, changed: draw,
});
const big = new BigValues(byId("tiles-of-state"));
const table = new StateTable();
const missions = new MissionPanel(draw, (file) => orders.upload(file));
const texts = new TextPanel();
const orderList = new OrderPanel();
page.running = (id) => orderList.running(id);
const orders = new Orders(byId("orders"), {
  vehicle: selected, seenAt: () => page.atSeconds, pick: () => pick(!map.isPicking), toast, record, changed: draw, running: page.running, preview,
});
const canSet = () => !page.isReadOnly && hasToken();
const parameters = new ParameterPanel((id, parameter) => { if (canSet()) orders.setParameter(id, parameter); }, canSet);

// ------------------------------------------------------------------------------------------- panels

const TABS = [["State", table], ["Mission", missions], ["Parameters", parameters], ["Messages", texts], ["Orders", orderList]];
let tab = table;
const tabButtons = TABS.map(([name, panel]) => element("button", { type: "button", role: "tab", onclick: () => open(panel) }, name));
byId("tabs").append(...tabButtons);

function open(panel) {
  tab = panel;
  TABS.forEach(([, each], index) => tabButtons[index].setAttribute("aria-selected", String(each === panel)));
  panel.show(selected(), page.receivedAt); // at once, because it has the values from when it was last open
  byId("panel").replaceChildren(panel.node);
  draw();
}

// ------------------------------------------------------------------------------------------- vehicles

function choose(id) {
  page.selected = id;
  pick(false);
  if (map.follows !== null) map.follows = id;
  missions.load(id);
  loadModes(id);
  draw();
}

async function loadModes(id) {
  page.modesOf = id;
  try {
    const found = await ask("GET", `api/vehicles/${id}`);
    if (page.selected === id) orders.showModes(found.modes);
  } catch { page.modesOf = undefined; }
}

function showVehicles() {
  const box = byId("vehicles");
  const ids = [...page.vehicles.keys()].sort((a, b) => a - b);
  if (box.dataset.ids !== ids.join()) {
    box.dataset.ids = ids.join();
    box.replaceChildren(...ids.map((id) => {
      const button = element("button", { type: "button", class: "vehicle", onclick: () => choose(id) }, element("span", { class: "dot" }), element("span", {}), element("small", {}));
      button.dataset.id = id;
      return button;
    }));
  }
  for (const button of box.children) {
    const vehicle = page.vehicles.get(Number(button.dataset.id));
    const state = page.isOpen ? vehicle.link.state : "lost";
    show(button.children[1], `${vehicle.system_id} ${vehicle.firmware}`);
    show(button.children[2], summary(vehicle, state));
    const [kind, title] = light(vehicle, page), dot = `dot ${state === "connected" ? kind : state}`; // as the readiness
    if (button.children[0].className !== dot) button.children[0].className = dot;
    button.title = `${title} · link ${state}`;
    button.setAttribute("aria-pressed", String(vehicle.system_id === page.selected));
  }
}

// The values by which several vehicles are compared.
function summary(vehicle, state) {
  if (state !== "connected") return state;
  const { mode, armed, position, batteries } = vehicle.states;
  const charge = batteries?.value?.[0]?.remaining_percent;
  return [
    mode?.value?.name, armed?.value ? number(position?.value?.altitude_relative_m, 0, "m") : "disarmed",
    typeof charge === "number" ? `${charge} %` : null,
  ].filter(Boolean).join(" · ");
}

const silent = new Set();

function addToTrack(id, entry) {
  if (!entry || entry.age_s > 3) silent.add(id);
  else map.addPoint(id, entry.value, silent.delete(id));
}

async function loadTrack(id) {
  try {
    map.loadTrack(id, (await ask("GET", `api/vehicles/${id}/track`)).points);
  } catch { /* the track begins now */ }
}

// Reads the parameters that say what the failsafe does, before the link is lost.
const asked = new Set();

function loadFailsafe(vehicle) {
  for (const name of isConnected(vehicle) ? [...vehicle.failsafe.unread, ...vehicle.unread] : []) {
    const key = `${vehicle.system_id} ${name}`;
    if (!asked.has(key)) ask("GET", `api/vehicles/${vehicle.system_id}/parameters/${name}`).catch(() => {});
    asked.add(key);
  }
}

// ------------------------------------------------------------------------------------------- the map

function heightNow() {
  const position = selected() && selected().states.position;
  const height = position && position.value.altitude_relative_m;
  return typeof height === "number" ? Math.max(1, Math.round(height)) : 10;
}

function pick(isOn) {
  map.isPicking = isOn && Boolean(selected());
  byId("map").classList.toggle("picking", map.isPicking);
  byId("hint").hidden = !map.isPicking;
  if (map.isPicking) show(byId("hint"), `click the target position for vehicle ${page.selected}`);
}

// The plan of the open upload dialog, until it closes; of its parts, the vehicle keeps those that the file does not have.
let previewed = null;

// Beside the dialog, which is not modal, only the map can be used.
function preview(plan) {
  if (plan) pick(false);
  if (plan && !previewed) map.showAll();
  else if (!plan && previewed) map.showBefore();
  previewed = plan;
  document.querySelectorAll("header, #banner, #notice, main > :not(#map-box)").forEach((each) => { each.inert = Boolean(plan); });
}

function shownPlan(vehicle) {
  const fence = missions.fence(page.selected);
  if (!previewed) return { plan: { items: missions.items(page.selected), current: vehicle ? currentItem(vehicle) : null }, fence };
  const { items, fence: { polygons, circles }, rally } = previewed, hasFence = polygons.length + circles.length > 0;
  return {
    plan: { items: items.length ? items : missions.items(page.selected), current: null },
    fence: { ...(hasFence ? { polygons, circles } : fence), rally: rally.length ? rally.map((each) => each.position).filter(Boolean) : fence.rally },
  };
}

function onMap(vehicle) {
  const { position, heading_deg, home, mode } = vehicle.states;
  const height = position && number(position.value.altitude_relative_m, 1, "m");
  const old = ageOf(position, page.receivedAt);
  const last = old > 3 ? `${age(old)} old` : height;
  const label = [vehicle.system_id, mode && mode.value && mode.value.name, height, old > 3 ? last : null];
  return {
    id: vehicle.system_id, position: position && position.value, heading: heading_deg && heading_deg.value,
    age: old, home: home && home.value, labels: [label, [vehicle.system_id, last], [vehicle.system_id]].map((parts) => parts.filter(Boolean).join(" · ")),
  };
}

// A plan dropped anywhere is uploaded to the selected vehicle, after confirmation.
window.addEventListener("dragover", (event) => {
  event.preventDefault();
  byId("drop").hidden = !selected() || page.isReadOnly;
  show(byId("drop"), `Drop a .plan or .waypoints file to upload it to vehicle ${page.selected}`);
});
window.addEventListener("dragleave", (event) => { if (!event.relatedTarget) byId("drop").hidden = true; });
window.addEventListener("drop", (event) => {
  event.preventDefault();
  byId("drop").hidden = true;
  const file = event.dataTransfer.files[0];
  if (file && !page.isReadOnly) orders.upload(file);
});

byId("zoom-in").onclick = () => map.leaflet.zoomIn(0.6);
byId("zoom-out").onclick = () => map.leaflet.zoomOut(0.6);
byId("fit").onclick = () => { Object.assign(map, { isMoved: false, follows: null, isFitted: false }); draw(); };
byId("follow").onclick = () => { map.follows = map.follows === null ? page.selected : null; map.isMoved = true; };
window.addEventListener("keydown", (event) => { if (event.key === "Escape") { pick(false); if (previewed) byId("dialog").close(); } });

// ------------------------------------------------------------------------------------------- showing

let isDrawn = false;

function draw() {
  if (isDrawn) return;
  isDrawn = true;
  requestAnimationFrame(() => { isDrawn = false; drawNow(); });
}

function drawNow() {
  const vehicle = selected();
  showVehicles();
  showSilences(byId("silences"), page);
  showCrashes(byId("crashes"), page);
  showReadiness(byId("readiness"), vehicle, page);
  big.show(vehicle, page.receivedAt);
  tab.show(vehicle, page.receivedAt);
  const attitude = vehicle && vehicle.states.attitude;
  drawAttitude(byId("attitude"), attitude && attitude.value, ageOf(attitude, page.receivedAt) > 3);
  const target = orders.target ?? page.running(page.selected).filter((each) => each.order === "go_to").pop()?.arguments;
  const { plan, fence } = shownPlan(vehicle);
  map.draw([...page.vehicles.values()].map(onMap), page.selected, plan, target, fence);
  byId("follow").setAttribute("aria-pressed", String(map.follows !== null));
  page.hasToken = hasToken();
  orders.enable(vehicle, page);
  orders.showTarget(vehicle, page.receivedAt);
  orders.recheck?.(page);
  placeToasts();
  showServer();
  showTokenNotice();
}

// A newer toast with the same key replaces the older one.
function toast(text, kind, key) {
  const made = element("button", { type: "button", class: `toast ${kind}`, title: "close", onclick: () => made.remove() }, ...unbroken(text));
  if (key !== undefined) {
    made.dataset.key = key;
    byId("toasts").querySelector(`[data-key="${CSS.escape(key)}"]`)?.remove();
  }
  byId("toasts").append(made);
  placeToasts();
  byId("toasts").scrollTop = byId("toasts").scrollHeight;
  setTimeout(() => made.remove(), kind === "failed" || kind === "note" ? 15000 : 5000);
}

// Toasts never cover the orders: they are above them, or below where there is more room.
function placeToasts() {
  const { top, bottom } = byId("orders").getBoundingClientRect(), gap = 8;
  const ceiling = Math.max(0, document.querySelector("header").getBoundingClientRect().bottom) + gap;
  const above = Math.min(top, innerHeight) - gap - ceiling, below = innerHeight - Math.max(bottom, ceiling) - 2 * gap;
  const box = byId("toasts").style, isAbove = above >= below;
  box.bottom = `${isAbove ? Math.max(gap, innerHeight - top + gap) : gap}px`;
  box.maxHeight = `${Math.max(0, isAbove ? above : below)}px`;
}

const announced = new Set();

function record(order, isNew = true) {
  const before = orderList.records.get(order.key);
  if (before && before.state !== "running") return;
  orderList.record(order);
  if (isNew && order.state !== "running" && order.order === "mission/upload") missions.reload(order.system_id);
  if (order.state !== "running" && order.order === "set_parameter" && order.result) {
    parameters.changed(order.system_id, order.arguments.name, order.result.value);
  }
  if (isNew && !announced.has(order.key + order.state)) {
    announced.add(order.key + order.state);
    const why = order.problem && !order.replaced_by ? `: ${inWords(order.problem, page.vehicles.get(order.system_id))}` : "";
    toast(`Vehicle ${order.system_id}: ${orderList.outcome(order)}${why}`, shownState(order), order.key);
  }
  draw();
}

// ------------------------------------------------------------------------------------------- the stream

// When the page saw the vehicle disarm, of performance.now().
function disarmedAt(before, now) {
  const hasDisarmed = before?.states.armed?.value === true && now.states.armed?.value === false;
  return hasDisarmed ? performance.now() : before?.disarmedAt;
}

function onEvent(event) {
  texts.add(event);
  if (event.event === "MissionFinished") orderList.finishMission(event.system_id, event.time_unix_s);
}

function onMessage(message) {
  if (message.type === "state") {
    page.receivedAt = performance.now();
    page.atSeconds = message.at_s;
    for (const { system_id } of message.vehicles) if (!page.vehicles.has(system_id)) loadTrack(system_id);
    message.vehicles.forEach((each) => { each.disarmedAt = disarmedAt(page.vehicles.get(each.system_id), each); });
    for (const each of message.vehicles) {
      const before = page.vehicles.get(each.system_id), text = disarmText(each);
      if (text && before && !disarmText(before)) toast(`Vehicle ${each.system_id}: ${text}`, "note");
      const causes = each.active_failsafe;
      if (causes && before && !before.active_failsafe) toast(`Vehicle ${each.system_id}: ${failsafeTitle(each)}. ${causes.join("; ")}`, "failed");
    }
    page.vehicles = new Map(message.vehicles.map((each) => [each.system_id, each]));
    message.vehicles.forEach(loadFailsafe);
    for (const { system_id, states } of message.vehicles) addToTrack(system_id, states.position);
    if (page.selected === undefined && page.vehicles.size) choose(Math.min(...page.vehicles.keys()));
    else if (selected() && page.modesOf !== page.selected) loadModes(page.selected);
  } else if (message.type === "event") {
    onEvent(message);
    if (message.event === "ParameterChanged") parameters.changed(message.system_id, message.name, message.after);
  } else if (message.type === "order") record(message);
  else if (message.type === "hello") {
    page.isReadOnly = message.read_only;
    message.orders.forEach((each) => record(each, false));
    message.events.forEach(onEvent);
  }
  draw();
}

function opened() {
  page.isOpen = true;
  byId("banner").hidden = true;
}

function closed(reason) {
  page.isOpen = false;
  const banner = byId("banner");
  banner.hidden = false;
  if (reason !== "unauthorized") show(banner, "No connection to the server: the values shown are old.");
  else if (!banner.querySelector("form")) askToken(banner);
  draw();
}

function askToken(banner) {
  const input = element("input", { type: "password", required: true, autocomplete: "off" });
  const form = element("form", { onsubmit: (event) => { event.preventDefault(); useToken(input.value); show(banner, "connecting …"); } },
    hasToken() ? "The token is invalid (the server may create a new one at each start): " : "This server needs its token: ", input, " ", element("button", { type: "submit" }, "Use"));
  banner.replaceChildren(form);
}

// Reading needs no token on this machine, orders do: ask before the first one.
function showTokenNotice() {
  const notice = byId("notice");
  notice.hidden = page.hasToken || page.isReadOnly || !page.isOpen;
  if (notice.hidden || notice.firstChild) return;
  const input = element("input", { type: "password", required: true, autocomplete: "off" });
  input.setAttribute("aria-label", "Token");
  notice.append(element("form", { onsubmit: (event) => { event.preventDefault(); useToken(input.value); input.value = ""; draw(); } },
    "You can look only: orders need the token, which aerokit serve prints in its address. ", input, " ", element("button", { type: "submit" }, "Use")));
}

function showServer() {
  const isFresh = page.isOpen && performance.now() - page.receivedAt < 3000;
  const silent = [...page.vehicles.values()].filter((each) => !isConnected(each));
  const loss = page.vehicles.size === 1 ? "vehicle silent" : `${silent.length} of ${page.vehicles.size} silent`;
  const text = !page.isOpen ? "no connection" : !isFresh ? "no data" : silent.length ? loss : page.vehicles.size ? "live" : "no vehicle";
  const limit = !isFresh ? "" : page.isReadOnly ? "read-only · " : hasToken() ? "" : "no token · ";
  show(byId("server"), `${limit}${text}`, `pill ${text === "live" ? "good" : text === "no vehicle" ? "" : "bad"}`);
}

ask("GET", "api").then((about) => {
  if (about.tiles) map.showTiles(about.tiles);
  Object.assign(bitNames, about.bits);
  show(byId("attribution"), about.tiles ? about.attribution : "");
  byId("server").title = `aerokit ${about.aerokit}`;
}).catch(() => {});
open(table);
openStream({ message: onMessage, opened, closed });
setInterval(draw, 500);
window.addEventListener("resize", draw);
window.addEventListener("scroll", placeToasts, { passive: true });
