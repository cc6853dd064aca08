// Orders: buttons, and the confirmation dialog that names vehicle and order. Every order needs it, and is sent once.

import { age, byId, element, shortest, show } from "./dom.js";
import { needsForce, orderFacts, valueProblem } from "./facts.js";
import { distanceText, offset } from "./map.js";
import { aboutParameter, parameterProblem, short, typeProblem } from "./panels.js";
import { capitalized, dialogObstacle, inWords, obstacle } from "./readiness.js";
import { ask, hasToken, newKey, Refusal, useToken } from "./server.js";
import { ageOf } from "./state.js";

// name, text of the button, text of the dialog (or a function of the values), fields [name, label, value, step], class of the button
export const BUTTONS = [
  ["arm", "Arm", "arm the motors: propellers may start to turn", [], "main"],
  ["take_off", "Take off", "take off and climb", [["altitude_m", "Metres above home", 10, "any"]], "main"],
  ["pick", "Go to …", "", [], "main"],
  ["hold", "Hold", "stop and hold its position", [], "rest"],
  ["land", "Land", "land at its current position", [], "rest"],
  ["return_to_launch", "Return", "return to the launch position and land there", [], "rest"],
  ["disarm", "Disarm", "stop the motors", [], ""],
  ["mission/start", "Start mission", ({ item = "N" }) => `fly its mission from item ${item}; it takes off if the mission has a takeoff item`, [["item", "From item", 0, "1"]], ""],
  ["mission/pause", "Pause", "pause its mission and hold", [], ""],
  ["mission/resume", "Resume", "resume its mission", [], ""],
];

const FAR_M = 10_000;

// How far away the first place of a mission is, as [text, warning]; the other one is "".
function distanceOfPlan(items, vehicle) {
  const there = items.find((each) => each.position)?.position, here = vehicle.states.position?.value;
  if (!there || !here) return ["", ""];
  const text = `Its first place is ${distanceText(here, there)} the vehicle`;
  return Math.hypot(...offset(here, there)) > FAR_M ? ["", `${text}: is this the plan for this vehicle?`] : [`${text}.`, ""];
}

export class Orders {
  // page: {vehicle(), seenAt(), pick(), toast(text, kind), record(order), changed(), running(id), preview(plan)}
  constructor(box, page) {
    this.page = page;
    this.buttons = [];
    this.target = null; // the position that the open dialog asks about
    this.recheck = null; // updates the open dialog
    byId("dialog").addEventListener("close", () => {
      if (!byId("dialog").open) {
        this.target = this.recheck = null;
        page.preview(null);
      }
      page.changed();
    });
    for (const [name, title, text, fields, kind] of BUTTONS) {
      const clicked = () => (name === "pick" ? page.pick() : this.confirm(this.wanted(name, title, text, fields)));
      const button = element("button", { type: "button", class: kind, onclick: clicked }, element("span", {}, title), element("small", {}));
      button.dataset.order = name;
      this.buttons.push(button);
      box.append(button);
    }
    this.modes = element("select", { onchange: () => this.modeChosen() });
    this.modes.setAttribute("aria-label", "Flight mode");
    this.buttons.push(this.modes);
    this.showModes([]);
    box.append(this.modes);
  }

  wanted(order, title, text, fields) {
    const vehicle = this.page.vehicle(), isForced = order === "disarm" && vehicle && needsForce(vehicle);
    return { order, title, text, fields, ...(isForced ? { fixed: { force: true } } : {}) };
  }

  // Disables what cannot work now, with the reason below the title.
  enable(vehicle, page) {
    for (const button of this.buttons) {
      const chosen = button.dataset.order ?? "mode", name = chosen === "pick" ? "go_to" : chosen, why = obstacle(name, vehicle, page);
      const isBusy = String(Boolean(vehicle) && this.page.running(vehicle.system_id).some((each) => each.order === name));
      if (button.getAttribute("aria-busy") !== isBusy) button.setAttribute("aria-busy", isBusy);
      const title = why === "Cannot arm" ? `Cannot arm: ${vehicle.not_armable.join("; ")}` : why;
      if (button.disabled !== Boolean(why)) button.disabled = Boolean(why);
      if (button.title !== title) button.title = title;
      button.classList.toggle("urgent", name === "disarm" && Boolean(vehicle?.crash));
      if (button !== this.modes) show(button.children[1], capitalized(why.split(": ").pop())); // the button is narrow
    }
  }

  async upload(file) {
    const vehicle = this.page.vehicle();
    if (!vehicle) return;
    try {
      const plan = await file.text(), name = file.name;
      const checked = await ask("POST", "api/plan", { plan, name });
      const { mission_items: count, fence_areas: areas, rally_points: rally } = checked;
      const parts = [[count, "mission items"], [areas, "fence areas"], [rally, "rally points"]];
      const [distance, warning] = distanceOfPlan(checked.items, vehicle);
      const replaced = parts.filter(([each]) => each).map(([each, what]) => `${each} ${each === 1 ? what.slice(0, -1) : what}`);
      const kept = parts.filter(([each]) => !each).map(([, what]) => what);
      this.confirm({
        order: "mission/upload", title: "Upload", fields: [], fixed: { name, plan }, preview: checked, place: "beside",
        text: `get ${replaced.join(", ") || "nothing"} from ${file.name}, in place of any it has`,
        about: [
          vehicle.states.armed?.value ? "The vehicle is armed." : "",
          "The map shows the plan.",
          distance,
          kept.length ? `It keeps its ${kept.join(" and ")}, because the file has none.` : "",
        ].filter(Boolean),
        facts: warning ? [warning] : [],
      });
    } catch (error) {
      this.page.toast(error instanceof Refusal ? inWords(error.problem) : `${file.name} was not checked: the server did not answer.`, "failed");
    }
  }

  showModes(names) {
    this.modes.replaceChildren(element("option", { value: "" }, "Mode …"), ...names.map((name) => element("option", { value: name }, name)));
  }

  modeChosen() {
    const mode = this.modes.value;
    this.modes.value = "";
    if (mode) this.confirm({ order: "mode", title: `Mode ${mode}`, text: `change its flight mode to ${mode}`, fields: [], fixed: { mode } });
  }

  // y: where the position is on the screen; the dialog leaves it free
  goTo(place, altitude, y) {
    this.confirm({
      order: "go_to", title: "Go to", fixed: place, target: place, place: `beside ${y < innerHeight / 2 ? "low" : "high"}`,
      text: `go to ${place.latitude_deg.toFixed(6)}, ${place.longitude_deg.toFixed(6)}`,
      fields: [["altitude_relative_m", "Metres above home", altitude, "any"], ["speed_m_s", "Speed in m/s (optional)", "", "any"]],
    });
  }

  // Shows where the target of the open dialog is, seen from the vehicle, which may be moving.
  showTarget(vehicle, receivedAt) {
    const line = this.target && byId("dialog").querySelector(".where"), position = vehicle?.states.position;
    if (!line) return;
    const old = ageOf(position, receivedAt);
    const name = old > 3 ? `the last position of the vehicle, ${age(old)} old` : "the vehicle";
    show(line, position ? `${distanceText(position.value, this.target)} ${name}` : "The position of the vehicle is unknown.");
  }

  setParameter(id, parameter) {
    this.confirm({
      impossible: ({ value }) => (value === undefined ? "" : typeProblem(parameter, value)),
      problem: ({ value }) => (value === undefined ? "" : parameterProblem(parameter, value)),
      vehicle: id, title: `Set ${parameter.name}`, text: `set ${parameter.name}, currently ${short(parameter.value)} ${parameter.unit ?? ""}`.trim(), about: aboutParameter(parameter),
      fields: [["value", "New value", parameter.value, "any"]], order: "parameter", parameter: parameter.name,
    });
  }

  confirm(wanted) {
    const vehicle = this.page.vehicle();
    if (!vehicle) return;
    const id = wanted.vehicle ?? vehicle.system_id; // fixed now, because the selection can change while the dialog is open
    const dialog = byId("dialog"), key = newKey();
    const inputs = wanted.fields.map(([name, label, value, step]) => {
      const input = element("input", { type: "number", step, name, required: value !== "" });
      input.value = typeof value === "number" ? shortest(value) : value;
      return [name, input, element("label", {}, label, input)];
    });
    const will = element("span", {}), facts = element("div", { class: "facts" });
    const yes = element("button", { type: "submit", class: "yes" }, `Yes, ${wanted.title.charAt(0).toLowerCase()}${wanted.title.slice(1)} · vehicle ${id}`);
    const problem = element("p", { class: "problem", hidden: true, role: "alert" });
    const force = element("input", { type: "checkbox", name: "force", onchange: () => enable() });
    const forced = element("label", { class: "force", hidden: true }, "Set it all the same", force);
    const values = () => Object.fromEntries(inputs.filter(([, input]) => input.value !== "").map(([name, input]) => [name, Number(input.value)]));
    const blocked = element("p", { class: "blocked", hidden: true, role: "alert" });
    const enable = () => { yes.disabled = !blocked.hidden || (!problem.hidden && !force.checked); };
    // The vehicle can disarm itself, land or become silent while the dialog is open.
    this.recheck = (page) => {
      const why = dialogObstacle(wanted.order, page.vehicles.get(id), page);
      show(blocked, why);
      blocked.hidden = !why;
      const lines = (wanted.facts ?? []).concat(orderFacts(wanted.order, page.vehicles.get(id), this.page.running(id)));
      if (facts.dataset.drawn !== lines.join("\n")) facts.replaceChildren(...lines.map((line) => element("p", {}, line)));
      facts.dataset.drawn = lines.join("\n");
      enable();
    };
    const check = () => {
      const impossible = wanted.impossible?.(values()) || valueProblem(wanted.order, values(), vehicle);
      const text = impossible || wanted.problem?.(values()) || "";
      show(problem, text);
      problem.hidden = !text;
      forced.hidden = !text || Boolean(impossible) || wanted.order !== "parameter";
      show(will, ` (${vehicle.firmware}) will ${typeof wanted.text === "function" ? wanted.text(values()) : wanted.text}.`);
      force.checked = false;
      enable();
    };
    const token = hasToken() ? null : element("input", { type: "password", required: true, autocomplete: "off" });
    const give = (event) => {
      event.preventDefault();
      if (token) useToken(token.value);
      const body = { ...wanted.fixed, ...values(), ...(force.checked ? { force: true } : {}) };
      dialog.close();
      this.give(id, wanted, body, key);
    };
    const cancel = element("button", { type: "button", onclick: () => dialog.close() }, "Cancel");
    dialog.className = wanted.place ?? "";
    dialog.replaceChildren(element("form", { onsubmit: give, oninput: (event) => { if (event.target !== force) check(); } },
      element("h2", {}, `${wanted.title}?`),
      element("p", {}, element("span", { class: "target" }, `Vehicle ${id}`), will),
      wanted.target ? element("p", { class: "where" }) : null,
      ...(wanted.about ?? []).map((line) => element("p", { class: "detail" }, line)),
      facts, ...inputs.map(([, , label]) => label), blocked, problem, forced,
      token ? element("label", {}, "Token", token) : null,
      element("div", { class: "buttons" }, cancel, yes)));
    if (dialog.open) dialog.close();
    this.target = wanted.target ?? null;
    this.page.preview(wanted.preview ?? null);
    if (wanted.preview) dialog.show();
    else dialog.showModal();
    check();
    this.page.changed();
    (inputs.length ? inputs[0][1] : token ?? cancel).focus();
  }

  // The server refuses values that metadata of the parameter's other name does not allow, which the page does not have.
  confirmRefused(wanted, { value }, problem) {
    this.confirm({ ...wanted, fields: [["value", "New value", value, "any"]], problem: (given) => (given.value === value ? problem.detail.split("; nothing was set")[0] : wanted.problem(given)) });
  }

  async give(id, wanted, body, key) {
    const isParameter = wanted.order === "parameter";
    const path = isParameter ? `parameters/${encodeURIComponent(wanted.parameter)}` : wanted.order;
    const headers = { "Idempotency-Key": key };
    if (this.page.seenAt() !== null) headers["Aerokit-Seen-At"] = String(this.page.seenAt());
    const what = `Vehicle ${id}: ${wanted.title}`;
    try {
      const record = await ask(isParameter ? "PUT" : "POST", `api/vehicles/${id}/${path}?wait=false`, body, headers);
      this.page.record(record);
    } catch (error) {
      if (error instanceof Refusal) {
        if (error.problem.status === 401) useToken("");
        if (error.problem.order) this.page.record(error.problem.order);
        else if (isParameter && !body.force && error.problem.detail?.includes('"force": true')) this.confirmRefused(wanted, body, error.problem);
        else this.page.toast(`${what}: ${inWords(error.problem)}`, "failed");
      } else this.page.toast(`${what}: the server did not answer, so it is unknown whether the order was sent. Check the tab Orders.`, "failed");
    }
  }
}
