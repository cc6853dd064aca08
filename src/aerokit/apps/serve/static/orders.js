// Orders: buttons, and the confirmation dialog that names vehicle and order. Every order needs it, and is sent once.

import { byId, element, show } from "./dom.js";
import { aboutParameter } from "./panels.js";
import { inWords, obstacle } from "./readiness.js";
import { ask, hasToken, newKey, Refusal, useToken } from "./server.js";

// name, text of the button, text of the dialog, fields [name, label, value, step], class of the button
export const BUTTONS = [
  ["arm", "Arm", "arm the motors: propellers may start to turn", [], "main"],
  ["take_off", "Take off", "take off and climb", [["altitude_m", "Metres above home", 10, "any"]], "main"],
  ["pick", "Go to …", "", [], "main"],
  ["hold", "Hold", "stop and hold its position", [], "rest"],
  ["land", "Land", "land at its current position", [], "rest"],
  ["return_to_launch", "Return", "return to the launch position", [], "rest"],
  ["disarm", "Disarm", "stop the motors", [], ""],
  null,
  ["mission/start", "Start mission", "fly its mission from an item; it takes off if the mission has a takeoff item", [["item", "From item", 0, "1"]], ""],
  ["mission/pause", "Pause", "pause its mission and hold", [], ""],
  ["mission/resume", "Resume", "resume its mission", [], ""],
];

export class Orders {
  // page: {vehicle(), seenAt(), pick(), toast(text, kind), record(order)}
  constructor(box, page) {
    this.page = page;
    this.buttons = [];
    for (const each of BUTTONS) {
      if (!each) { box.append(element("span", { class: "gap" })); continue; }
      const [name, title, text, fields, kind] = each;
      const clicked = () => (name === "pick" ? page.pick() : this.confirm({ order: name, title, text, fields }));
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

  // Disables what cannot work now, with the reason below the title.
  enable(vehicle, page) {
    for (const button of this.buttons) {
      const name = button.dataset.order ?? "mode", why = obstacle(name === "pick" ? "go_to" : name, vehicle, page);
      if (button.disabled !== Boolean(why)) button.disabled = Boolean(why);
      if (button.title !== why) button.title = why;
      if (button !== this.modes) show(button.children[1], why);
    }
  }

  async upload(file) {
    const vehicle = this.page.vehicle();
    if (!vehicle) return;
    try {
      const plan = await file.text(), name = file.name;
      const { mission_items: count, fence_areas: areas, rally_points: rally } = await ask("POST", "api/plan", { plan, name });
      const parts = [[count, "mission items"], [areas, "fence areas"], [rally, "rally points"]];
      const replaced = parts.filter(([each]) => each).map(([each, what]) => `${each} ${each === 1 ? what.slice(0, -1) : what}`);
      this.confirm({
        order: "mission/upload", title: "Upload", fields: [], fixed: { name, plan },
        text: `get ${replaced.join(", ") || "nothing"} from ${file.name}, instead of those it has`,
        about: [
          vehicle.states.armed?.value ? "The vehicle is armed." : "",
          areas && rally ? "" : "What the file does not contain (fence, rally points) stays as it is.",
        ].filter(Boolean),
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

  goTo(place, altitude) {
    this.confirm({
      order: "go_to", title: "Go to", fixed: place,
      text: `go to ${place.latitude_deg.toFixed(6)}, ${place.longitude_deg.toFixed(6)}`,
      fields: [["altitude_relative_m", "Metres above home", altitude, "any"], ["speed_m_s", "Speed in m/s (optional)", "", "any"]],
    });
  }

  setParameter(id, parameter) {
    this.confirm({
      vehicle: id, title: `Set ${parameter.name}`, text: `set ${parameter.name}, currently ${parameter.value} ${parameter.unit ?? ""}`.trim(), about: aboutParameter(parameter),
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
      input.value = typeof value === "number" ? String(+value.toFixed(7)) : value;
      return [name, input, element("label", {}, label, input)];
    });
    const token = hasToken() ? null : element("input", { type: "password", required: true, autocomplete: "off" });
    const give = (event) => {
      event.preventDefault();
      if (token) useToken(token.value);
      const body = { ...wanted.fixed };
      for (const [name, input] of inputs) if (input.value !== "") body[name] = Number(input.value);
      dialog.close();
      this.give(id, wanted, body, key);
    };
    const cancel = element("button", { type: "button", onclick: () => dialog.close() }, "Cancel");
    dialog.replaceChildren(element("form", { onsubmit: give },
      element("h2", {}, `${wanted.title}?`),
      element("p", {}, element("span", { class: "target" }, `Vehicle ${id}`), ` (${vehicle.firmware}) will ${wanted.text}.`),
      ...(wanted.about ?? []).map((line) => element("p", { class: "detail" }, line)),
      ...inputs.map(([, , label]) => label),
      token ? element("label", {}, "Token", token) : null,
      element("div", { class: "buttons" }, cancel, element("button", { type: "submit", class: "yes" }, `Yes, ${wanted.title.charAt(0).toLowerCase()}${wanted.title.slice(1)} · vehicle ${id}`))));
    if (dialog.open) dialog.close();
    dialog.showModal();
    (inputs.length ? inputs[0][1] : token ?? cancel).focus();
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
        else this.page.toast(`${what}: ${inWords(error.problem)}`, "failed");
      } else this.page.toast(`${what}: the server did not answer, so it is unknown whether the order was sent. Check the tab Orders.`, "failed");
    }
  }
}
