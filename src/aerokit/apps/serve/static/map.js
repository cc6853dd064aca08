// The map: a plane in metres around the first known position, drawn on a canvas; tiles only if a server is configured.

// Colours are those of page.css, which has them for light and dark.
let style = getComputedStyle(document.documentElement);
const colour = (name) => style.getPropertyValue(`--${name}`).trim();
export const colourOf = (id) => colour(`vehicle-${(id - 1) % 8}`);
const METRES_PER_DEGREE = 111195;
const MAX_POINTS = 5000;
const MAX_AGE_S = 3;
const BUTTONS_WIDTH = 52, BUTTONS_HEIGHT = 170; // pixels of the buttons at the top right

const DIRECTIONS = ["north", "north-east", "east", "south-east", "south", "south-west", "west", "north-west"];

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

export class MapView {
  constructor(canvas, picked) {
    this.canvas = canvas;
    this.context = canvas.getContext("2d");
    this.picked = picked;
    this.origin = null;
    this.centre = { x: 0, y: 0 };
    this.scale = 4; // pixels per metre
    this.isMoved = false;
    this.follows = null;
    this.tracks = new Map();
    this.tiles = null;
    this.images = new Map();
    this.isPicking = false;
    this.listen();
  }

  toPlane(latitude, longitude) {
    if (!this.origin) this.origin = { latitude, longitude, cosine: Math.max(0.01, Math.cos(latitude * Math.PI / 180)) };
    let away = longitude - this.origin.longitude;
    if (away > 180) away -= 360; else if (away < -180) away += 360;
    return { x: away * this.origin.cosine * METRES_PER_DEGREE, y: (latitude - this.origin.latitude) * METRES_PER_DEGREE };
  }

  toPlace(point) {
    return {
      latitude_deg: this.origin.latitude + point.y / METRES_PER_DEGREE,
      longitude_deg: this.origin.longitude + point.x / METRES_PER_DEGREE / this.origin.cosine,
    };
  }

  toScreen(point) {
    return {
      x: this.width / 2 + (point.x - this.centre.x) * this.scale,
      y: this.height / 2 - (point.y - this.centre.y) * this.scale,
    };
  }

  fromScreen(x, y) {
    return { x: this.centre.x + (x - this.width / 2) / this.scale, y: this.centre.y - (y - this.height / 2) / this.scale };
  }

  place(position) { return this.toScreen(this.toPlane(position.latitude_deg, position.longitude_deg)); }

  // gap: where the vehicle was before this point is unknown
  addPoint(id, position, gap) {
    const track = this.tracks.get(id) || [];
    this.tracks.set(id, track);
    const point = this.toPlane(position.latitude_deg, position.longitude_deg);
    const last = track[track.length - 1];
    if (!last || Math.hypot(point.x - last.x, point.y - last.y) > 0.3) track.push({ ...point, gap });
    if (track.length > MAX_POINTS) track.splice(0, MAX_POINTS / 5);
  }

  // points: [latitude, longitude, gap] from the server, before those that have been added here
  loadTrack(id, points) {
    this.tracks.set(id, [...points.map(([latitude, longitude, gap]) => ({ ...this.toPlane(latitude, longitude), gap })), ...(this.tracks.get(id) || [])]);
  }

  zoom(factor, x = this.width / 2, y = this.height / 2) {
    const before = this.fromScreen(x, y);
    this.scale = Math.min(200, Math.max(0.0005, this.scale * factor));
    const after = this.fromScreen(x, y);
    this.centre.x += before.x - after.x;
    this.centre.y += before.y - after.y;
    this.isMoved = true;
  }

  fit(points) {
    const known = points.map((each) => this.toPlane(each.latitude_deg, each.longitude_deg));
    for (const track of this.tracks.values()) known.push(...track);
    if (!known.length) return;
    const [left, right] = [Math.min(...known.map((p) => p.x)), Math.max(...known.map((p) => p.x))];
    const [low, high] = [Math.min(...known.map((p) => p.y)), Math.max(...known.map((p) => p.y))];
    this.centre = { x: (left + right) / 2, y: (low + high) / 2 };
    const [wide, tall] = [Math.max(30, right - left), Math.max(30, high - low)];
    this.scale = 0.72 * Math.min((this.width - BUTTONS_WIDTH) / wide, this.height / tall);
    this.centre.x += BUTTONS_WIDTH / 2 / this.scale; // everything is to the left of the buttons
  }

  // Fits everything into the map until `showBefore`.
  showAll() {
    this.before = { centre: this.centre, scale: this.scale, isMoved: this.isMoved, follows: this.follows };
    Object.assign(this, { isMoved: false, follows: null });
  }

  showBefore() { Object.assign(this, this.before); }

  listen() {
    const fingers = new Map();
    let travelled = 0;
    const at = (event) => {
      const box = this.canvas.getBoundingClientRect();
      return { x: event.clientX - box.left, y: event.clientY - box.top };
    };
    this.canvas.addEventListener("pointerdown", (event) => {
      if (!fingers.size) travelled = 0;
      fingers.set(event.pointerId, at(event));
      this.canvas.setPointerCapture(event.pointerId);
    });
    this.canvas.addEventListener("pointermove", (event) => {
      const before = fingers.get(event.pointerId);
      if (!before) return;
      const now = at(event);
      travelled += Math.hypot(now.x - before.x, now.y - before.y);
      if (fingers.size === 2) {
        const other = [...fingers.entries()].find(([id]) => id !== event.pointerId)[1];
        const spread = (point) => Math.max(1, Math.hypot(point.x - other.x, point.y - other.y));
        this.zoom(spread(now) / spread(before), other.x, other.y);
      } else if (travelled > 4) {
        this.centre.x -= (now.x - before.x) / this.scale;
        this.centre.y += (now.y - before.y) / this.scale;
        this.isMoved = true;
        this.follows = null;
      }
      fingers.set(event.pointerId, now);
    });
    const lift = (event) => {
      const place = fingers.get(event.pointerId);
      fingers.delete(event.pointerId);
      if (place && event.type === "pointerup" && travelled <= 4 && this.isPicking && this.origin) {
        this.picked(this.toPlace(this.fromScreen(place.x, place.y)), event.clientY);
      }
    };
    this.canvas.addEventListener("pointerup", lift);
    this.canvas.addEventListener("pointercancel", lift);
    this.canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      const place = at(event);
      this.zoom(Math.exp(-event.deltaY * 0.0015), place.x, place.y);
    }, { passive: false });
  }

  // vehicles: [{id, position, heading, age, labels, home}], plan: {items, current}, target: {position},
  // fence: {polygons, circles, rally}
  draw(vehicles, selected, plan, target, fence) {
    style = getComputedStyle(document.documentElement);
    const box = this.canvas.getBoundingClientRect();
    const ratio = window.devicePixelRatio || 1;
    [this.width, this.height] = [box.width, box.height];
    const [wide, tall] = [Math.round(box.width * ratio), Math.round(box.height * ratio)];
    if (this.canvas.width !== wide || this.canvas.height !== tall) [this.canvas.width, this.canvas.height] = [wide, tall];
    const pen = this.context;
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.fillStyle = colour("map");
    pen.fillRect(0, 0, this.width, this.height);
    const items = plan.items.filter((item) => item.position);
    const places = [...vehicles.flatMap((each) => [each.position, each.home]), ...items.map((item) => item.position),
      ...fence.polygons.flatMap((each) => each.vertices), ...fence.rally].filter(Boolean);
    // What labels must not cover, as [left, top, right, bottom]: the buttons and the scale, then what is drawn.
    this.taken = [[this.width - BUTTONS_WIDTH, 0, this.width, BUTTONS_HEIGHT], [0, this.height - 40, 40 + this.step() * this.scale, this.height]];
    if (!places.length) return this.drawNothing();
    const followed = vehicles.find((each) => each.id === this.follows && each.position);
    if (followed) this.centre = this.toPlane(followed.position.latitude_deg, followed.position.longitude_deg);
    else if (!this.isMoved) this.fit(places);
    if (this.tiles) this.drawTiles();
    this.drawGrid();
    for (const [id, track] of this.tracks) this.drawTrack(track, colourOf(id), id === selected);
    this.drawFence(fence);
    this.drawPlan(items, plan.current, colourOf(selected || 1));
    for (const each of vehicles) if (each.home) this.drawHome(each.home, colourOf(each.id));
    const chosen = vehicles.find((each) => each.id === selected);
    if (target) this.drawTarget(target, chosen);
    const drawn = vehicles.filter((each) => each.position).sort((a, b) => (a.id === selected) - (b.id === selected));
    for (const each of drawn) this.drawVehicle(each, each.id === selected);
    for (const each of drawn.reverse()) this.label(each);
    this.drawScale();
    return undefined;
  }

  drawNothing() {
    this.context.fillStyle = colour("dim");
    this.context.font = "14px system-ui, sans-serif";
    this.context.textAlign = "center";
    this.context.fillText("no position known", this.width / 2, this.height / 2);
  }

  step() {
    const raw = 80 / this.scale, power = 10 ** Math.floor(Math.log10(raw));
    return power * [1, 2, 5, 10].find((each) => each * power >= raw);
  }

  drawGrid() {
    const pen = this.context, step = this.step();
    const first = this.fromScreen(0, this.height), last = this.fromScreen(this.width, 0);
    pen.lineWidth = 1;
    for (let x = Math.ceil(first.x / step); x * step <= last.x; x++) {
      const at = this.toScreen({ x: x * step, y: 0 }).x;
      this.line([{ x: at, y: 0 }, { x: at, y: this.height }], colour(this.tiles ? "grid-on-tiles" : x % 5 ? "grid" : "grid-5"));
    }
    for (let y = Math.ceil(first.y / step); y * step <= last.y; y++) {
      const at = this.toScreen({ x: 0, y: y * step }).y;
      this.line([{ x: 0, y: at }, { x: this.width, y: at }], colour(this.tiles ? "grid-on-tiles" : y % 5 ? "grid" : "grid-5"));
    }
  }

  line(points, stroke, dash = []) {
    const pen = this.context;
    pen.beginPath();
    points.forEach((each, index) => (index && !each.gap ? pen.lineTo(each.x, each.y) : pen.moveTo(each.x, each.y)));
    pen.strokeStyle = stroke;
    pen.setLineDash(dash);
    pen.stroke();
    pen.setLineDash([]);
  }

  drawTrack(track, stroke, isSelected) {
    this.context.lineJoin = "round";
    this.context.lineWidth = isSelected ? 2.5 : 1.5;
    this.context.globalAlpha = isSelected ? 0.9 : 0.5;
    this.line(track.map((each) => ({ ...this.toScreen(each), gap: each.gap })), stroke);
    this.context.globalAlpha = 1;
  }

  // Areas to stay inside of are outlined, areas to stay out of are filled.
  drawFence({ polygons, circles, rally }) {
    const pen = this.context;
    pen.lineWidth = 2;
    const area = (inclusion) => {
      pen.fillStyle = pen.strokeStyle = colour(inclusion ? "good" : "bad");
      pen.setLineDash(inclusion ? [10, 4] : []);
      pen.stroke();
      pen.setLineDash([]);
      pen.globalAlpha = 0.18;
      if (!inclusion) pen.fill();
      pen.globalAlpha = 1;
    };
    for (const { vertices, inclusion } of polygons) {
      pen.beginPath();
      for (const each of vertices.map((vertex) => this.place(vertex))) pen.lineTo(each.x, each.y);
      pen.closePath();
      area(inclusion);
    }
    for (const { center, radius_m, inclusion } of circles) {
      const at = this.place(center);
      pen.beginPath();
      pen.arc(at.x, at.y, radius_m * this.scale, 0, 7);
      area(inclusion);
    }
    for (const each of rally) this.marker(this.place(each), "R", colour("map"), colour("good"), colour("good"));
  }

  drawPlan(items, current, chosen) {
    const points = items.map((item) => this.place(item.position));
    this.context.lineWidth = 1.5;
    this.line(points, colour("plan"), [6, 5]);
    items.forEach((item, index) => {
      const isCurrent = item.index === current;
      this.marker(points[index], String(item.index), isCurrent ? chosen : colour("map"), isCurrent ? colour("text") : colour("plan"), colour(isCurrent ? "map" : "text"));
    });
  }

  marker(at, text, fill, stroke, ink) {
    this.circle(at, 10, fill, stroke);
    this.text(text, at.x, at.y + 4, ink, "bold 11px", "center");
    this.take(at, 11);
  }

  take(at, radius) { this.taken.push([at.x - radius, at.y - radius, at.x + radius, at.y + radius]); }

  circle(at, radius, fill, stroke) {
    const pen = this.context;
    pen.beginPath();
    pen.arc(at.x, at.y, radius, 0, 7);
    pen.fillStyle = fill;
    pen.fill();
    pen.strokeStyle = stroke;
    pen.stroke();
  }

  text(text, x, y, ink, font = "12px", align = "left") {
    const pen = this.context;
    pen.font = `${font} system-ui, "DejaVu Sans", sans-serif`;
    pen.textAlign = align;
    pen.fillStyle = ink;
    pen.fillText(text, x, y);
  }

  drawHome(home, ink) {
    this.context.lineWidth = 2;
    this.marker(this.place(home), "H", colour("map"), ink, ink);
  }

  drawTarget(position, vehicle) {
    const at = this.place(position), pen = this.context;
    pen.lineWidth = 2;
    if (vehicle && vehicle.position) this.line([this.place(vehicle.position), at], colour("plan"), [3, 5]);
    this.line([{ x: at.x - 14, y: at.y }, { x: at.x + 14, y: at.y }], colour("accent"));
    this.line([{ x: at.x, y: at.y - 14 }, { x: at.x, y: at.y + 14 }], colour("accent"));
    pen.lineWidth = 3;
    pen.beginPath();
    pen.arc(at.x, at.y, 9, 0, 7);
    pen.stroke();
    this.take(at, 15);
  }

  drawVehicle(vehicle, isSelected) {
    const pen = this.context, at = this.place(vehicle.position), isOld = !(vehicle.age <= MAX_AGE_S);
    pen.save();
    pen.translate(at.x, at.y);
    pen.beginPath();
    if (typeof vehicle.heading === "number") {
      pen.rotate(vehicle.heading * Math.PI / 180);
      [[0, -15], [10, 11], [0, 6], [-10, 11]].forEach(([x, y], index) => (index ? pen.lineTo(x, y) : pen.moveTo(x, y)));
      pen.closePath();
    } else pen.arc(0, 0, 8, 0, 7);
    pen.fillStyle = isOld ? colour("map") : colourOf(vehicle.id); // hollow: the last known position
    pen.fill();
    pen.lineWidth = isOld || isSelected ? 2.5 : 1;
    pen.strokeStyle = isOld ? colourOf(vehicle.id) : colour(isSelected ? "text" : "map");
    pen.stroke();
    pen.restore();
    this.take(at, 14);
  }

  // The longest label that has room next to the vehicle.
  label(vehicle) {
    const at = this.place(vehicle.position), pen = this.context;
    pen.font = "600 12px system-ui, 'DejaVu Sans', sans-serif";
    for (const text of vehicle.labels) {
      const wide = pen.measureText(text).width + 12, left = at.x - wide - 16, middle = at.x - wide / 2;
      const corners = [[at.x + 16, at.y - 24], [at.x + 16, at.y + 6], [left, at.y - 24], [left, at.y + 6], [middle, at.y - 38], [middle, at.y + 20]];
      const box = corners.map(([x, y]) => [x, y, x + wide, y + 18]).find((each) => this.isFree(each));
      if (!box) continue;
      pen.fillStyle = colour("label");
      pen.fillRect(box[0], box[1], wide, 18);
      this.text(text, box[0] + 6, box[1] + 13, colour(vehicle.age <= MAX_AGE_S ? "text" : "warn"), "600 12px");
      this.taken.push(box);
      return;
    }
  }

  isFree([left, top, right, bottom]) {
    return left >= 2 && top >= 2 && right <= this.width - 2 && bottom <= this.height - 2
      && this.taken.every((each) => right < each[0] || left > each[2] || bottom < each[1] || top > each[3]);
  }

  drawScale() {
    const step = this.step(), long = step * this.scale, y = this.height - 14;
    this.context.lineWidth = 2;
    this.line([{ x: 14, y: y - 5 }, { x: 14, y }, { x: 14 + long, y }, { x: 14 + long, y: y - 5 }], colour("plan"));
    this.text(step >= 1000 ? `${step / 1000} km` : `${+step.toPrecision(2)} m`, 14 + long / 2, y - 6, colour("text"), "12px", "center");
    this.text("N ↑", 14, 22, colour("dim"), "bold 12px");
  }

  drawTiles() {
    const metres = 40075016 * this.origin.cosine;
    const level = Math.max(0, Math.min(19, Math.round(Math.log2(metres * this.scale / 256))));
    const count = 2 ** level;
    const column = (longitude) => (longitude + 180) / 360 * count;
    const row = (latitude) => (1 - Math.asinh(Math.tan(latitude * Math.PI / 180)) / Math.PI) / 2 * count;
    const latitudeOf = (y) => Math.atan(Math.sinh(Math.PI * (1 - 2 * y / count))) * 180 / Math.PI;
    const first = this.toPlace(this.fromScreen(0, 0)), last = this.toPlace(this.fromScreen(this.width, this.height));
    const [left, right] = [Math.floor(column(first.longitude_deg)), Math.floor(column(last.longitude_deg))];
    const [top, bottom] = [Math.floor(row(Math.min(85, first.latitude_deg))), Math.floor(row(Math.max(-85, last.latitude_deg)))];
    if ((right - left + 1) * (bottom - top + 1) > 200) return;
    for (let x = left; x <= right; x++) for (let y = Math.max(0, top); y <= Math.min(count - 1, bottom); y++) {
      const image = this.tile(level, ((x % count) + count) % count, y);
      if (!image.complete || !image.naturalWidth) continue;
      const a = this.toScreen(this.toPlane(latitudeOf(y), x / count * 360 - 180));
      const b = this.toScreen(this.toPlane(latitudeOf(y + 1), (x + 1) / count * 360 - 180));
      this.context.globalAlpha = 0.75;
      this.context.drawImage(image, a.x, a.y, b.x - a.x + 0.5, b.y - a.y + 0.5);
      this.context.globalAlpha = 1;
    }
  }

  tile(z, x, y) {
    const url = this.tiles.replaceAll("{z}", z).replaceAll("{x}", x).replaceAll("{y}", y);
    let image = this.images.get(url);
    if (!image) {
      image = new Image();
      image.src = url;
      this.images.set(url, image);
      if (this.images.size > 400) this.images.delete(this.images.keys().next().value);
    }
    return image;
  }
}
