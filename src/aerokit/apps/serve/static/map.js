// The map: Leaflet projects, zooms and draws; map tiles are loaded only if a tile server is configured.

import "./vendor/leaflet/leaflet.js";
import { byId, element } from "./dom.js";

const { L } = window;
const METRES_PER_DEGREE = 111195;
const MAX_POINTS = 5000;
const MAX_AGE_S = 3;
const MIN_FITTED_M = 30;
const CLICK_RADIUS = 20; // pixels around a vehicle in which a click selects it
const BUTTONS_WIDTH = 52, BUTTONS_HEIGHT = 170; // pixels of the buttons at the top right
const ARROW = "M0-15L10 11L0 6L-10 11Z", DISC = "M-8 0A8 8 0 1 1 8 0A8 8 0 1 1-8 0", CROSS = "M-14 0H14M0-14V14M9 0A9 9 0 1 1-9 0A9 9 0 1 1 9 0";
const DIRECTIONS = ["north", "north-east", "east", "south-east", "south", "south-west", "west", "north-west"];

L.Renderer.mergeOptions({ padding: 0.5 }); // so much is drawn around the view, for when it is dragged
L.Draggable.mergeOptions({ clickTolerance: 8 }); // pixels that a hand may move during a click
const pen = document.createElement("canvas").getContext("2d");
pen.font = '600 12px system-ui, "DejaVu Sans", sans-serif'; // as the labels in page.css

// Metres north and east from one position to another.
export function offset(from, to) {
  const away = ((to.longitude_deg - from.longitude_deg + 540) % 360) - 180;
  return [(to.latitude_deg - from.latitude_deg) * METRES_PER_DEGREE, away * METRES_PER_DEGREE * Math.cos(from.latitude_deg * Math.PI / 180)];
}

// "13 m north-east of": from one position to another.
export function distanceText(from, to) {
  const [north, east] = offset(from, to), metres = Math.hypot(north, east);
  if (metres < 1) return "less than 1 m from";
  const direction = DIRECTIONS[(Math.round(Math.atan2(east, north) * 4 / Math.PI) + 8) % 8];
  return `${metres < 1000 ? `${metres.toFixed(0)} m` : `${(metres / 1000).toFixed(1)} km`} ${direction} of`;
}

const colourOf = (id) => `var(--vehicle-${(id - 1) % 8})`;

// A shape of 32 pixels around its position, turned clockwise.
function shape(className, path, degrees = 0) {
  const svg = byId("shape").content.firstElementChild.cloneNode(true);
  svg.firstElementChild.setAttribute("d", path);
  svg.firstElementChild.setAttribute("transform", `rotate(${degrees})`);
  return L.divIcon({ className: `shape ${className}`, html: svg, iconSize: [32, 32] });
}

const disc = (className, text) => L.divIcon({ className: `disc ${className}`, html: element("span", {}, text), iconSize: [22, 22] });

export class MapView {
  // picked(position, y): a target was clicked; chosen(id): a vehicle was clicked; changed(): the view has changed
  constructor(node, { picked, chosen, changed }) {
    this.isMoved = false;
    this.follows = null;
    this.isPicking = false;
    this.isAutomatic = false; // the view is changed by this class, not by the user
    this.isFitted = false; // the view shows everything
    this.tracks = new Map();
    this.crafts = new Map(); // where each vehicle is drawn
    this.layers = new Map(); // by key: the layer, and the text by which it is known whether it has changed
    this.leaflet = L.map(node, {
      center: [0, 0], zoom: 2, minZoom: 2, maxZoom: 24, zoomSnap: 0, zoomAnimation: false, zoomControl: false, attributionControl: false,
      trackResize: false, wheelPxPerZoomLevel: 160,
    });
    for (const pane of ["grid", "plan"]) this.leaflet.createPane(pane); // page.css has their order
    L.control.scale({ imperial: false }).addTo(this.leaflet);
    this.leaflet.on("click", ({ latlng, containerPoint, originalEvent }) => {
      const clicked = [...this.crafts].find(([, at]) => this.leaflet.latLngToContainerPoint(at).distanceTo(containerPoint) <= CLICK_RADIUS);
      if (this.isPicking) picked(this.position(latlng), originalEvent.clientY);
      else if (clicked) chosen(clicked[0]);
    });
    this.leaflet.on("zoomstart dragstart", () => { if (!this.isAutomatic) this.isMoved = true; });
    this.leaflet.on("dragstart", () => { this.follows = null; });
    this.leaflet.on("moveend", () => { if (!this.isAutomatic) changed(); });
    new ResizeObserver(() => {
      this.isFitted = false;
      this.automatically(() => this.leaflet.invalidateSize({ animate: false }));
      changed();
    }).observe(node);
  }

  automatically(change) {
    this.isAutomatic = true;
    try { change(); } finally { this.isAutomatic = false; }
  }

  showTiles(url) {
    L.tileLayer(url, { maxNativeZoom: 19, maxZoom: 24, opacity: 0.75 }).addTo(this.leaflet);
    this.leaflet.getContainer().classList.add("tiled");
  }

  // Longitudes are near the first one, so that nothing is torn apart at 180°.
  point({ latitude_deg, longitude_deg }) {
    this.longitude_deg ??= longitude_deg;
    return L.latLng(latitude_deg, longitude_deg + 360 * Math.round((this.longitude_deg - longitude_deg) / 360));
  }

  position(point) { return { latitude_deg: point.lat, longitude_deg: point.wrap().lng }; }

  // gap: where the vehicle was before this point is unknown
  addPoint(id, position, gap) {
    const track = this.tracks.get(id) ?? { points: [], changes: 0 }, at = this.point(position);
    this.tracks.set(id, track);
    if (track.points.length && at.distanceTo(track.points.at(-1).at) < 0.3) return;
    track.points.push({ at, gap });
    if (track.points.length > MAX_POINTS) track.points.splice(0, MAX_POINTS / 5);
    track.changes += 1;
  }

  // points: [latitude, longitude, gap] from the server, before those that have been added here
  loadTrack(id, points) {
    const { points: added, changes } = this.tracks.get(id) ?? { points: [], changes: 0 };
    const loaded = points.map(([latitude_deg, longitude_deg, gap]) => ({ at: this.point({ latitude_deg, longitude_deg }), gap }));
    this.tracks.set(id, { points: [...loaded, ...added], changes: changes + 1 });
  }

  // Fits everything into the map until `showBefore`.
  showAll() {
    this.before = { center: this.leaflet.getCenter(), zoom: this.leaflet.getZoom(), isMoved: this.isMoved, follows: this.follows };
    Object.assign(this, { isMoved: false, isFitted: false, follows: null });
  }

  showBefore() {
    const { center, zoom, isMoved, follows } = this.before;
    this.automatically(() => this.leaflet.setView(center, zoom, { animate: false }));
    Object.assign(this, { isMoved, follows, isFitted: false });
  }

  fit(places) {
    const points = [...places.map((place) => this.point(place)), ...[...this.tracks.values()].flatMap((track) => track.points.map(({ at }) => at))];
    const bounds = L.latLngBounds(points), { x, y } = this.leaflet.getSize();
    bounds.extend(bounds.getCenter().toBounds(MIN_FITTED_M));
    const margin = L.point(0.14 * (x - BUTTONS_WIDTH), 0.14 * y), buttons = L.point(BUTTONS_WIDTH, 0); // everything is to the left of the buttons
    const zoom = this.leaflet.getBoundsZoom(bounds, false, margin.multiplyBy(2).add(buttons));
    // A view that shows everything is kept until everything fits twice as large: each new zoom loads all tiles again.
    const inner = [margin.divideBy(3), L.point(x, y).subtract(buttons).subtract(margin.divideBy(3))].map((at) => this.leaflet.containerPointToLatLng(at));
    if (this.isFitted && L.latLngBounds(inner).contains(bounds) && zoom < this.leaflet.getZoom() + 1) return;
    this.isFitted = true;
    this.leaflet.fitBounds(bounds, { animate: false, paddingTopLeft: margin, paddingBottomRight: margin.add(buttons) });
  }

  // vehicles: [{id, position, heading, age, labels, home}], plan: {items, current}, target: {position},
  // fence: {polygons, circles, rally}
  draw(vehicles, selected, plan, target, fence) {
    const items = plan.items.filter((item) => item.position);
    const places = [...vehicles.flatMap((each) => [each.position, each.home]), ...items.map((item) => item.position),
      ...fence.polygons.flatMap((each) => each.vertices), ...fence.rally].filter(Boolean);
    this.leaflet.getContainer().classList.toggle("empty", !places.length);
    this.unused = new Set(this.layers.keys());
    if (places.length) {
      const followed = vehicles.find((each) => each.id === this.follows && each.position);
      this.automatically(() => {
        if (followed) this.leaflet.setView(this.point(followed.position), this.leaflet.getZoom(), { animate: false });
        else if (!this.isMoved) this.fit(places);
      });
      this.drawAll(vehicles, selected, { ...plan, items, all: plan.items }, target, fence);
    }
    for (const key of this.unused) {
      this.layers.get(key).layer.remove();
      this.layers.delete(key);
    }
  }

  drawAll(vehicles, selected, plan, target, fence) {
    const { x, y } = this.leaflet.getSize();
    // What labels must not cover, as [left, top, right, bottom]: the buttons and the scale, then what is drawn.
    this.taken = [[x - BUTTONS_WIDTH, 0, x, BUTTONS_HEIGHT], [0, y - 36, 130, y]];
    this.drawGrid();
    for (const [id, track] of this.tracks) this.drawTrack(id, track, id === selected);
    this.drawFence(fence);
    const chosen = vehicles.find((each) => each.id === selected);
    this.drawPlan(plan, chosen);
    for (const { id, home } of vehicles) if (home) this.mark(`home ${id}`, home, [`home`, "H"], disc, { id });
    if (target) this.drawTarget(target, chosen?.position);
    const drawn = vehicles.filter((each) => each.position).sort((a, b) => (b.id === selected) - (a.id === selected));
    this.crafts = new Map(drawn.map((each) => [each.id, this.point(each.position)]));
    for (const each of drawn) this.drawVehicle(each, each.id === selected);
    for (const each of drawn) this.label(each);
  }

  // Shows a layer, which is made only if it is new or its description has changed.
  put(key, description, make, id) {
    const text = JSON.stringify(description), known = this.layers.get(key);
    this.unused.delete(key);
    if (known?.text === text) return;
    known?.layer.remove();
    const layer = make().addTo(this.leaflet);
    if (id !== undefined) layer.getElement().style.setProperty("--own", colourOf(id));
    this.layers.set(key, { text, layer });
  }

  // Shows an icon, which labels must not cover. iconArguments: the arguments of makeIcon
  mark(key, position, iconArguments, makeIcon, { id, zIndexOffset = 0 } = {}) {
    const at = this.point(position), { x, y } = this.leaflet.latLngToContainerPoint(at);
    this.taken.push([x - 13, y - 13, x + 13, y + 13]);
    this.put(key, [at, iconArguments, zIndexOffset], () => L.marker(at, { icon: makeIcon(...iconArguments), interactive: false, keyboard: false, zIndexOffset }), id);
  }

  // Lines in steps of 1, 2 or 5 times a power of ten metres, at least 80 pixels apart.
  drawGrid() {
    const view = this.leaflet.getBounds(), center = this.leaflet.getSize().divideBy(2);
    const metres = this.leaflet.containerPointToLatLng(center).distanceTo(this.leaflet.containerPointToLatLng(center.add([80, 0])));
    const power = 10 ** Math.floor(Math.log10(metres)), step = power * [1, 2, 5, 10].find((each) => each * power >= metres);
    const { lat } = view.getCenter();
    this.put("grid", [view.toBBoxString()], () => {
      const drawn = view.pad(0.5), low = drawn.getSouthWest(), high = drawn.getNorthEast(), lines = [];
      const across = step / METRES_PER_DEGREE, along = across / Math.cos(lat * Math.PI / 180);
      for (let x = Math.ceil(low.lng / along); x * along < high.lng; x++) lines.push([[low.lat, x * along], [high.lat, x * along]]);
      for (let y = Math.ceil(low.lat / across); y * across < high.lat; y++) lines.push([[y * across, low.lng], [y * across, high.lng]]);
      return L.polyline(lines, { className: "grid", pane: "grid", weight: 1, interactive: false });
    });
  }

  drawTrack(id, { points, changes }, isSelected) {
    this.put(`track ${id}`, [changes, isSelected], () => {
      const pieces = [[]];
      for (const { at, gap } of points) {
        if (gap) pieces.push([]);
        pieces.at(-1).push(at);
      }
      return L.polyline(pieces, { className: `track ${isSelected ? "selected" : ""}`, interactive: false });
    }, id);
  }

  // Areas to stay inside of are outlined, areas to stay out of are filled.
  drawFence({ polygons, circles, rally }) {
    const options = (inclusion) => ({ className: `fence ${inclusion ? "inside" : "outside"}`, fill: !inclusion, interactive: false });
    polygons.forEach((area, index) => this.put(`polygon ${index}`, area, () => L.polygon(area.vertices.map((each) => this.point(each)), options(area.inclusion))));
    circles.forEach((area, index) => this.put(`circle ${index}`, area, () => L.circle(this.point(area.center), { radius: area.radius_m, ...options(area.inclusion) })));
    rally.forEach((each, index) => this.mark(`rally ${index}`, each, ["rally", "R"], disc));
  }

  // The line begins at home, and ends there if the mission does. all: also the items without a position
  drawPlan({ items, all, current }, vehicle) {
    const places = items.map((item) => item.position), home = vehicle?.home;
    if (home && all.length) places.unshift(home);
    if (home && all.at(-1)?.name === "NAV_RETURN_TO_LAUNCH") places.push(home);
    const points = places.map((place) => this.point(place));
    this.put("plan", points, () => L.polyline(points, { className: "plan", pane: "plan", interactive: false }));
    for (const { index, position } of items) {
      this.mark(`item ${index}`, position, [`item ${index === current ? "current" : ""}`, index], disc, { id: vehicle?.id ?? 1 });
    }
  }

  drawTarget(position, vehicle) {
    const points = vehicle ? [this.point(vehicle), this.point(position)] : [];
    this.put("way", points, () => L.polyline(points, { className: "way", pane: "plan", interactive: false }));
    this.mark("target", position, ["target", CROSS], shape);
  }

  // A hollow shape is the last known position.
  drawVehicle({ id, position, heading, age }, isSelected) {
    const className = `craft ${isSelected ? "selected" : ""} ${age <= MAX_AGE_S ? "" : "old"}`;
    const hasHeading = typeof heading === "number";
    this.mark(`vehicle ${id}`, position, [className, hasHeading ? ARROW : DISC, hasHeading ? heading : 0], shape, { id, zIndexOffset: isSelected ? 2e6 : 1e6 });
  }

  // The longest label that has room next to the vehicle.
  label({ id, position, age, labels }) {
    const point = this.point(position), at = this.leaflet.latLngToContainerPoint(point);
    for (const text of labels) {
      const wide = Math.ceil(pen.measureText(text).width) + 12, left = at.x - wide - 16, middle = at.x - wide / 2;
      const corners = [[at.x + 16, at.y - 24], [at.x + 16, at.y + 6], [left, at.y - 24], [left, at.y + 6], [middle, at.y - 38], [middle, at.y + 20]];
      const box = corners.map(([x, y]) => [x, y, x + wide, y + 18]).find((each) => this.isFree(each));
      if (!box) continue;
      const iconAnchor = [at.x - box[0], at.y - box[1]], className = `label ${age <= MAX_AGE_S ? "" : "old"}`;
      this.put(`label ${id}`, [point, text, iconAnchor, className], () => {
        const icon = L.divIcon({ className, html: element("span", {}, text), iconSize: [wide, 18], iconAnchor });
        return L.marker(point, { icon, interactive: false, keyboard: false, zIndexOffset: 3e6 });
      });
      this.taken.push(box);
      return;
    }
  }

  isFree([left, top, right, bottom]) {
    const { x, y } = this.leaflet.getSize();
    return left >= 2 && top >= 2 && right <= x - 2 && bottom <= y - 2
      && this.taken.every((each) => right < each[0] || left > each[2] || bottom < each[1] || top > each[3]);
  }
}
