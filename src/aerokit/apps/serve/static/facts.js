// What a dialog says about an order before it is given: values that cannot work, and what it changes or replaces.

import { clock, number, spelled, UNKNOWN } from "./dom.js";
import { orderTitle } from "./panels.js";
import { crashText, flightGap, modeChange, SURFACE_TYPES, withoutSource } from "./readiness.js";

// Orders that replace a running one of this set.
const MOTION = new Set(["take_off", "go_to", "hold", "land", "return_to_launch", "mode", "mission/start", "mission/pause", "mission/resume"]);
const SUBMARINE = 12, MAX_ALTITUDE_M = 10_000;

// Why these values cannot work, as a sentence; "" if they may.
export function valueProblem(order, values, vehicle) {
  const { altitude_m: height, altitude_relative_m: target, speed_m_s: speed, item } = values;
  const count = vehicle?.mission_items;
  if (order === "take_off" && height <= 0) return "The altitude must be above 0 m.";
  if (order === "go_to" && target < 0 && vehicle?.vehicle_type !== SUBMARINE) return "The altitude must be 0 m or more: below home there is ground.";
  if (Math.max(height ?? 0, target ?? 0) > MAX_ALTITUDE_M) return "The altitude must be at most 10,000 m.";
  if (speed <= 0) return "The speed must be above 0 m/s.";
  if (item !== undefined && (item < 0 || !Number.isInteger(item))) return "The item must be a whole number from 0.";
  if (item !== undefined && count > 0 && item >= count) return `The mission has the items 0 to ${count - 1}.`;
  return "";
}

// The altitude above home that a running order leads to; undefined if there is none.
export function targetAltitude(running) {
  const last = running.filter((each) => each.order === "take_off" || each.order === "go_to").pop();
  return last?.arguments.altitude_m ?? last?.arguments.altitude_relative_m;
}

// What the person who gives an order should know, one line each. running: the vehicle's running orders.
export function orderFacts(order, vehicle, running) {
  if (!vehicle) return [];
  if (order === "arm") return armFacts(vehicle);
  if (order === "disarm") return vehicle.crash ? crashFacts(vehicle) : [];
  if (!MOTION.has(order)) return [];
  const replaced = running.filter((each) => MOTION.has(each.order)).map(orderTitle);
  if (!replaced.length && vehicle.is_flying_mission && !order.startsWith("mission/")) replaced.push(`its mission${itemText(vehicle)}`);
  const facts = replaced.length ? [`Replaces: ${replaced.join(", ")}`] : [];
  return order === "return_to_launch" ? [...facts, ...returnFacts(vehicle)] : facts;
}

// At which altitude the vehicle returns. ArduCopter and PX4 climb less if home is near (RTL_CONE_SLOPE, RTL_CONE_ANG).
function returnFacts({ return_altitude_m: height, firmware, vehicle_type: type }) {
  if (SURFACE_TYPES.has(type)) return [];
  if (height !== null && height <= 0) return ["It returns at its present altitude."];
  const altitude = height === null ? "its return altitude" : `${+height.toFixed(1)} m above home`;
  return [firmware === "ArduPlane" ? `It returns at ${altitude}.` : `It first climbs to ${altitude}, unless it is higher. Near home it may climb less.`];
}

const itemText = ({ mission_item: item, mission_items: count }) =>
  (typeof item === "number" && count ? `, now at item ${item} of 0 to ${count - 1}` : "");

// A crashed vehicle that does not know that it is on the ground disarms only by force.
export const needsForce = (vehicle) => Boolean(vehicle.crash) && vehicle.states.landed_state?.value !== "ON_GROUND";

function armFacts(vehicle) {
  const { missing_for_flight: missing, crash, disarm_parameter: parameter, disarm_delay_s: delay } = vehicle, change = modeChange(vehicle);
  const disarms = parameter && (delay === null ? "usually disarms itself after 10 s" : delay > 0 && `disarms itself after ${delay} s`);
  return [
    crash ? `${crashText(vehicle)}.` : "",
    change && `${change}.`,
    disarms && `If it does not take off, it ${disarms} (${parameter}).`,
    missing.length ? `${flightGap(vehicle)}: ${missing.map(withoutSource).join("; ")}.` : "",
  ].filter(Boolean);
}

function crashFacts(vehicle) {
  const { position, ground_speed_m_s: speed, landed_state: landed } = vehicle.states;
  const now = [
    `${number(position?.value?.altitude_relative_m, 1, "m")} above home`, number(speed?.value, 1, "m/s"),
    `it reports “${landed?.value ? spelled(landed.value) : UNKNOWN}”`,
  ];
  return [`${crashText(vehicle)}.`, `Now: ${now.join(", ")}.`, needsForce(vehicle) ? "The motors stop whatever it reports: if it flies after all, it falls." : ""].filter(Boolean);
}
