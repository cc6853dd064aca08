// Readiness and silence in words: what a vehicle lacks, which orders cannot work now and why, and lost vehicles.

import { age, clock, element, number, show, UNKNOWN } from "./dom.js";
import { ageOf } from "./state.js";

// Orders that the server also tries on a silent vehicle.
const SAFE_ORDERS = new Set(["disarm", "hold", "land", "return_to_launch", "mission/pause"]);
// MAV_TYPE: ground rover, boat, submarine.
export const SURFACE_TYPES = new Set([10, 11, 12]);
const FLYING = new Set(["IN_AIR", "TAKEOFF", "LANDING"]);
const MAX_REASONS = 4;
// What the page calls the library's actions.
const TITLES = {
  arm: "Arm", take_off: "Take off", go_to: "Go to …", hold: "Hold", land: "Land", return_to_launch: "Return", disarm: "Disarm",
  start: "Start mission", pause: "Pause", resume: "Resume", upload: "Upload a plan …", set_mode: "Mode …",
};

const valueOf = (vehicle, name) => (vehicle.states[name] || {}).value;
const MAX_LANDED_AGE_S = 3; // an older state must not keep anyone from landing
const landedState = (vehicle) => (vehicle.states.landed_state?.age_s < MAX_LANDED_AGE_S ? valueOf(vehicle, "landed_state") : undefined);
export const isConnected = (vehicle) => vehicle.link.state === "connected";

// The reason why an order cannot work now, as an instruction where there is one; "" if it may work.
export function obstacle(order, vehicle, page) {
  if (!page.isOpen) return "No connection";
  if (page.isReadOnly) return "Read-only";
  if (page.hasToken === false) return "No token";
  if (!vehicle) return "No vehicle";
  const isArmed = valueOf(vehicle, "armed"), landed = landedState(vehicle);
  const isOnGround = landed === "ON_GROUND", isFlying = FLYING.has(landed);
  const mission = valueOf(vehicle, "mission_current"), isSurface = SURFACE_TYPES.has(vehicle.vehicle_type);
  // Motors that stop in the air make the vehicle fall: the page disarms only what is known to stand.
  if (!isConnected(vehicle)) return order === "disarm" && !isSurface ? "May be flying" : SAFE_ORDERS.has(order) ? "" : "Silent";
  switch (order) {
    case "arm":
      if (isArmed) return "Armed";
      return vehicle.not_armable?.length ? "Cannot arm" : "";
    case "disarm":
      return isArmed === false ? "Disarmed" : isSurface || isOnGround || vehicle.crash ? "" : isFlying ? "Land first" : "May be flying";
    case "take_off":
      if (page.running?.(vehicle.system_id).some((each) => each.order === "take_off")) return "Running";
      return isSurface ? "Does not fly" : isArmed === false ? "Arm first" : vehicle.crash ? "Crashed" : isFlying ? "Flying" : lacksPosition(vehicle) ? "No position" : "";
    case "go_to":
      return isArmed === false ? "Arm first" : vehicle.crash ? "Crashed" : isOnGround && !isSurface ? "Take off first" : lacksPosition(vehicle) ? "No position" : "";
    case "return_to_launch":
      if (isArmed && isOnGround && !isSurface) return "On the ground";
      // falls through
    case "hold": case "land": return isArmed === false && isOnGround ? "Not flying" : "";
    case "mission/start": case "mission/resume":
      if (vehicle.mission_items === 0) return "No mission";
      if (isArmed === false) return "Arm first";
      if (vehicle.crash) return "Crashed";
      if (vehicle.is_flying_mission && mission?.state === "ACTIVE" && (isFlying || isSurface)) return "Running";
      // ArduCopter, on the ground after a finished mission, would take off and fly from the first item.
      if (order === "mission/resume" && isOnGround && !isSurface) return "On the ground: use Start";
      return lacksPosition(vehicle) ? "No position" : "";
    case "mission/pause":
      return isArmed === false || mission?.state === "NO_MISSION" || !vehicle.is_flying_mission ? "None runs" : "";
    default: return "";
  }
}

const EKF_POS_HORIZ = 8 + 16, EKF_CONST_POS_MODE = 128; // bits of EKF_STATUS_REPORT: relative or absolute position

// ArduCopter, armed, changes to GUIDED and AUTO only with a horizontal position (system.cpp, position_ok).
function lacksPosition(vehicle) {
  const estimator = vehicle.states.estimator;
  if (vehicle.firmware !== "ArduCopter" || estimator?.value?.message !== "EKF_STATUS_REPORT" || estimator.age_s > 5) return false;
  return !(estimator.value.flags & EKF_POS_HORIZ) || Boolean(estimator.value.flags & EKF_CONST_POS_MODE);
}

// What a vehicle that arms cannot do yet. The page uses these words wherever it does not say "Cannot arm".
export function flightGap(vehicle) {
  if (!vehicle.states.sensors) return "Not known yet whether it can arm";
  if (SURFACE_TYPES.has(vehicle.vehicle_type)) return "Arms, but cannot drive by itself yet";
  return lacksPosition(vehicle) ? "Arms, but cannot take off yet" : "Arms, but is not ready to fly";
}

export const withoutSource = (reason) => reason.replace(/ \([A-Z_]+\)$/, "");

// "It hit the ground at 11.6 m/s at 06:07:11 and has not moved since"
export function crashText(vehicle, name = "It") {
  const since = isConnected(vehicle) && valueOf(vehicle, "armed") ? " and has not moved since" : "";
  return `${name} ${vehicle.crash.text.replace(/^the vehicle /, "")} at ${clock(vehicle.crash.at_unix_s)}${since}`;
}

// How a vehicle disarmed that was not in the air, without an order of this server; "" if it was longer ago.
export function disarmText({ disarming: known }) {
  if (!known || known.age_s * 1000 > RECENT_MS) return "";
  const after = `${Math.round(known.armed_for_s)} s after arming`, { parameter, delay_s: delay } = known;
  if (known.is_automatic) return `Disarmed by the vehicle ${after}, because it was not in the air (${parameter} = ${delay} s)`;
  const isOff = delay !== null && delay <= 0;
  return `Disarmed ${after}, not by an order of this server${parameter && !isOff ? ` (${parameter}${delay === null ? "" : ` = ${delay} s`})` : ""}`;
}

export const failsafeTitle = (vehicle) => `Failsafe: ${valueOf(vehicle, "mode")?.name ?? UNKNOWN}`;

const RECENT_MS = 60_000;

// Why a vehicle that was armed a short time ago is disarmed; "" if the page has not seen it armed, or longer ago.
function recentDisarm(vehicle) {
  const since = performance.now() - (vehicle?.disarmedAt ?? -Infinity);
  if (valueOf(vehicle ?? { states: {} }, "armed") || since > RECENT_MS) return "";
  const parameter = vehicle.disarm_parameter;
  const delay = parameter && ` ${vehicle.firmware} disarms itself on the ground after ${parameter}, 10 s by default.`;
  return ` It disarmed ${age(Math.max(1, since / 1000))} ago.${delay ?? ""}`;
}

// The reason why the order of an open dialog cannot work now, as sentences; "" if it may work.
export function dialogObstacle(order, vehicle, page) {
  const why = obstacle(order, vehicle, { ...page, hasToken: true }); // the dialog asks for the token
  if (why === "Arm first") return `The vehicle is not armed: press “Arm” first.${recentDisarm(vehicle)}`;
  return why && `Not possible now: ${why.charAt(0).toLowerCase()}${why.slice(1)}.`;
}

// An error of the library for a person: without names of functions and messages.
export function inWords(problem, vehicle) {
  const text = problem.detail
    .replace(/^(?:[a-z]+\.)?([a-z_]+)(?:\(\))?: /, (prefix, name) => (name in TITLES ? "" : prefix))
    .replace(/MAV_CMD_\w+ was refused: (\w+)/g, (_, result) => `The vehicle refused (${result.toLowerCase().replaceAll("_", " ")})`)
    .replace(/\bcall (?=[a-z_]+\(\))/g, "press ")
    .replace(/\b([a-z_]+)\(\)/g, (_, name) => `“${TITLES[name] ?? name.replaceAll("_", " ")}”`);
  return capitalized(text) + (text.includes("not armed") ? recentDisarm(vehicle).replace(/^ /, ". ") : "");
}

export const capitalized = (text) => text.replace(/^[a-z](?=[a-z]* )/, (letter) => letter.toUpperCase()); // not file names

// What arming in a mode that does not allow it does; "" if arming leaves the mode as it is.
export function modeChange({ firmware, unarmable_mode: mode }) {
  if (!mode?.arms_in) return "";
  if (mode.unless) return `If the vehicle refuses to arm in ${mode.mode} (${mode.unless}), Arm changes the mode to ${mode.arms_in} and arms there`;
  return `Arm changes the mode to ${mode.arms_in} first: ${firmware} cannot arm in ${mode.mode}`;
}

// Class of the light of a vehicle, and its title.
export const light = (vehicle, page) => readiness(vehicle, page, heartbeatAge(vehicle, page));

// [class of the light, title, reasons, what is missing for a flight only]
function readiness(vehicle, page, heartbeatAge) {
  if (!vehicle) return ["unknown", "No vehicle yet", []];
  if (!page.isOpen) return ["unknown", "Readiness unknown", ["No connection to the server"]];
  if (!isConnected(vehicle)) return ["bad", `No contact for ${age(heartbeatAge)}`, []];
  const missing = vehicle.missing_for_flight, landed = landedState(vehicle), disarmed = disarmText(vehicle);
  if (vehicle.crash) {
    const title = valueOf(vehicle, "armed") === false ? "Crashed" : "Crashed: propellers may turn";
    return ["bad", title, [crashText(vehicle), ...missing]];
  }
  if (valueOf(vehicle, "armed")) {
    const isOnGround = landed === "ON_GROUND", texts = vehicle.active_failsafe;
    const title = isOnGround ? "Armed: propellers may turn" : FLYING.has(landed) ? "Flying" : "Armed";
    if (texts) return ["warn", failsafeTitle(vehicle), [...(isOnGround ? [title] : []), ...texts, ...missing]];
    return [missing.length || isOnGround ? "warn" : "good", title, missing];
  }
  const notes = [disarmed, modeChange(vehicle)].filter(Boolean), against = vehicle.not_armable;
  if (against.length) {
    const forFlight = missing.filter((reason) => !against.includes(reason));
    return ["warn", "Cannot arm", [...against, ...(disarmed ? [disarmed] : [])], forFlight];
  }
  return missing.length ? ["warn", flightGap(vehicle), [...missing, ...notes]] : ["good", "Ready to arm", notes];
}

export function showReadiness(box, vehicle, page) {
  const [kind, title, reasons, forFlight = []] = readiness(vehicle, page, vehicle && heartbeatAge(vehicle, page));
  const drawn = [kind, title, ...reasons, "", ...forFlight].join("\n");
  if (box.dataset.drawn === drawn) return;
  box.dataset.drawn = drawn;
  const [items, others] = [reasons, forFlight].map((texts) => texts.map((text) => element("li", {}, capitalized(withoutSource(text)))));
  const more = items.splice(MAX_REASONS), isOpen = box.querySelector("details")?.open ?? false, count = more.length + others.length;
  const flight = others.length ? [element("div", {}, "Also missing for flight:"), element("ul", {}, ...others)] : [];
  const rest = count ? element("details", { open: isOpen }, element("summary", {}, `and ${count} more`), element("ul", {}, ...more), ...flight) : null;
  box.className = kind;
  box.replaceChildren(...[element("span", { class: "light" }), element("strong", {}, title), element("ul", {}, ...items), rest].filter(Boolean));
}

const heartbeatAge = (vehicle, page) => ageOf({ age_s: vehicle.link.heartbeat_age_s }, page.receivedAt);

// One banner for each vehicle without contact: since when, where it was, and what its failsafe does.
export function showSilences(box, page) {
  const lost = page.isOpen ? [...page.vehicles.values()].filter((each) => !isConnected(each)) : [];
  const ids = lost.map((each) => each.system_id).join();
  if (box.dataset.ids !== ids) {
    box.dataset.ids = ids;
    box.replaceChildren(...lost.map(() => element("div", { class: "silence" },
      element("strong", { role: "alert" }), element("span", {}), element("span", {}))));
  }
  lost.forEach((vehicle, index) => {
    const [title, place, failsafe] = box.children[index].children, silence = heartbeatAge(vehicle, page);
    const since = silence === undefined ? "" : ` since ${clock(Math.round(Date.now() / 1000 - silence))}`;
    show(title, `Vehicle ${vehicle.system_id} is silent${since}`);
    show(place, `${silence === undefined ? "" : `For ${age(silence)}. `}${lastPosition(vehicle, page)}`);
    show(failsafe, failsafeText(vehicle.failsafe));
  });
}

// One banner for each vehicle that hit the ground.
export function showCrashes(box, page) {
  const crashed = page.isOpen ? [...page.vehicles.values()].filter((each) => each.crash) : [];
  const texts = crashed.map((each) => {
    const isArmed = valueOf(each, "armed") !== false;
    return `${crashText(each, `Vehicle ${each.system_id}`)}. ${isArmed ? "It is still armed: propellers may turn." : "It is disarmed."}`;
  });
  if (box.dataset.drawn === texts.join("\n")) return;
  box.dataset.drawn = texts.join("\n");
  box.replaceChildren(...texts.map((text) => element("div", { class: "silence" }, element("strong", { role: "alert" }, text))));
}

function lastPosition(vehicle, page) {
  const entry = vehicle.states.position;
  if (!entry) return "Its position is unknown.";
  const { latitude_deg, longitude_deg, altitude_relative_m } = entry.value;
  const height = typeof altitude_relative_m === "number" ? `, ${number(altitude_relative_m, 1, "m")} above home` : "";
  return `Last position, ${age(ageOf(entry, page.receivedAt))} old: ${number(latitude_deg, 6)}, ${number(longitude_deg, 6)}${height}.`;
}

const failsafeText = ({ action, because }) =>
  action ? `If it lost its ground station too, it ${action} (${because}).` : "What its failsafe does is unknown.";
