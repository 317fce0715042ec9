// Pictures on canvases: the plan with map, areas, arcs and robot; and the course of the probabilities.

const GOLDEN = 0.6180339887498949;
const FACTORS = [1, 2, 5, 10, 20, 50, 100];
const VISIBLE = 14; // px, of the largest ellipse of an arc

/** The colour of a hypothesis: neighbouring numbers are far apart. */
export function colour(hypothesis) {
  const hue = ((0.58 + hypothesis * GOLDEN) % 1) * 360;
  return `hsl(${hue.toFixed(0)} 62% ${hypothesis % 2 ? 54 : 44}%)`;
}

/** A canvas with as many pixels as the screen has for it; returns its context and its size in CSS pixels. */
export function prepared(canvas) {
  const ratio = window.devicePixelRatio || 1;
  const { clientWidth: width, clientHeight: height } = canvas;
  if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
    canvas.width = Math.round(width * ratio);
    canvas.height = Math.round(height * ratio);
  }
  const context = canvas.getContext("2d");
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.clearRect(0, 0, width, height);
  return { context, width, height };
}

/** What the style sheet calls by this name, such as "--wall". */
export function themed(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(name).trim();
}

const ROBOTS = ["#1f77b4", "#e0730d", "#2ca02c", "#d62768", "#9467bd", "#8c6d31", "#17a2b8", "#7f7f7f"];

/** The colour of a robot of the team, by its place among the names. */
export function robotColour(place) {
  return ROBOTS[place % ROBOTS.length];
}

/** The map's picture in the colours of the theme, or of another robot, on a canvas of its own. */
export function tinted(image, paint) {
  const canvas = document.createElement("canvas");
  canvas.width = image.naturalWidth;
  canvas.height = image.naturalHeight;
  const context = canvas.getContext("2d", { willReadFrequently: true });
  context.drawImage(image, 0, 0);
  const picture = context.getImageData(0, 0, canvas.width, canvas.height);
  const [free, wall] = paint ? [rgb(paint), rgb(paint)] : ["--free", "--wall"].map((name) => rgb(themed(name)));
  const { data } = picture;
  for (let k = 0; k < data.length; k += 4) {
    if (data[k] < 40) {
      data[k + 3] = 0;
    } else {
      const isWall = data[k] > 128;
      [data[k], data[k + 1], data[k + 2]] = isWall ? wall : free;
      if (paint) data[k + 3] = isWall ? 200 : 40;
    }
  }
  context.putImageData(picture, 0, 0);
  return canvas;
}

function rgb(hex) {
  return [1, 3, 5].map((k) => parseInt(hex.slice(k, k + 2), 16));
}

/** From metres in the map to pixels of the canvas, and back. */
export class Camera {
  constructor() {
    [this.x, this.y, this.scale] = [0, 0, 30];
    [this.width, this.height] = [1, 1];
  }

  toScreen([x, y]) {
    return [this.width / 2 + (x - this.x) * this.scale, this.height / 2 - (y - this.y) * this.scale];
  }

  toMap([u, v]) {
    return [this.x + (u - this.width / 2) / this.scale, this.y - (v - this.height / 2) / this.scale];
  }

  /** Zoom so that what is under a pixel stays there. */
  zoom(factor, pixel) {
    const [x, y] = this.toMap(pixel);
    this.scale = Math.min(2000, Math.max(0.5, this.scale * factor));
    const [u, v] = this.toScreen([x, y]);
    this.move(pixel[0] - u, pixel[1] - v);
  }

  move(du, dv) {
    this.x -= du / this.scale;
    this.y += dv / this.scale;
  }

  fit([left, bottom], [width, height]) {
    this.x = left + width / 2;
    this.y = bottom + height / 2;
    this.scale = 0.9 * Math.min(this.width / Math.max(width, 4), this.height / Math.max(height, 4));
  }
}

/** Draw the plan; returns what was drawn, and where: {areas, arcs, closures, robot, factor, map, middle, spots, team}. */
export function drawPlan(canvas, camera, state, picture, trail, team) {
  const { context, width, height } = prepared(canvas);
  [camera.width, camera.height] = [width, height];
  context.fillStyle = themed("--unknown");
  context.fillRect(0, 0, width, height);
  const drawn = { areas: 0, arcs: 0, closures: 0, robot: null, factor: 1, map: false, spots: [] };
  drawn.middle = [camera.x, camera.y];
  if (state.map && picture) {
    const [left, bottom] = state.map.origin;
    const [u, v] = camera.toScreen([left, bottom + state.map.size[1]]);
    context.imageSmoothingEnabled = camera.scale * (state.map.size[0] / picture.width) < 1;
    context.drawImage(picture, u, v, state.map.size[0] * camera.scale, state.map.size[1] * camera.scale);
    drawn.map = true;
  }
  drawn.team = team.map((other) => drawOther(context, camera, other));
  drawTrail(context, camera, trail);
  if (state.graph) {
    drawn.factor = factorOf(state.graph, camera);
    state.graph.arcs.forEach((arc) => drawArc(context, camera, arc, drawn.factor));
    state.graph.areas.forEach((area) => drawArea(context, camera, area, area.area === Number(state.area)));
    drawn.areas = state.graph.areas.length;
    drawn.spots = state.graph.areas.map(({ area, at }) => ({ area, at: camera.toScreen(at).map(Math.round) }));
    drawn.arcs = state.graph.arcs.length;
    drawn.closures = state.graph.arcs.filter((arc) => arc.closure).length;
  }
  if (state.robot) {
    drawRobot(context, camera, state.robot);
    drawn.robot = state.robot.pose;
  }
  return drawn;
}

/** By how much the ellipses of arcs are drawn larger, so that one sees them. */
function factorOf(graph, camera) {
  const largest = Math.max(0, ...graph.arcs.map((arc) => arc.ellipse?.[0] ?? 0)) * camera.scale;
  return FACTORS.find((factor) => factor * largest >= VISIBLE) ?? (largest ? FACTORS.at(-1) : 1);
}

/** Draw the map and the pose of another robot that is joined; returns its name, and whether each of them was drawn. */
function drawOther(context, camera, { name, frame, map, robot, paint, picture }) {
  if (map && picture) {
    const [left, bottom] = map.origin;
    const [u, v] = camera.toScreen(frame);
    context.save();
    context.translate(u, v);
    context.rotate(-frame[2]);
    const [width, height] = map.size.map((length) => length * camera.scale);
    context.imageSmoothingEnabled = width < picture.width;
    context.drawImage(picture, left * camera.scale, -bottom * camera.scale - height, width, height);
    context.restore();
  }
  if (robot) drawArrow(context, camera, robot, paint, name);
  return { name, map: Boolean(map && picture), robot: Boolean(robot) };
}

function drawTrail(context, camera, trail) {
  context.strokeStyle = themed("--path");
  context.lineWidth = 1.5;
  context.lineJoin = "round";
  context.beginPath();
  trail.forEach((point, k) => {
    const [u, v] = camera.toScreen(point);
    const jump = k === 0 || Math.hypot(point[0] - trail[k - 1][0], point[1] - trail[k - 1][1]) > 5;
    if (jump) context.moveTo(u, v);
    else context.lineTo(u, v);
  });
  context.stroke();
}

function ellipse(context, camera, at, [longer, shorter, angle], least = 0) {
  const [u, v] = camera.toScreen(at);
  const half = [longer, shorter].map((length) => Math.max(least, length * camera.scale));
  context.beginPath();
  context.ellipse(u, v, ...half, -angle, 0, 2 * Math.PI);
}

/** An arc that could be any is dashed. */
function drawArc(context, camera, arc, factor) {
  const [start, end] = arc.ends.map((point) => camera.toScreen(point));
  context.strokeStyle = context.fillStyle = themed(arc.closure ? "--closure" : "--arc");
  context.lineWidth = arc.closure ? 2.5 : 1.5;
  context.setLineDash(arc.ellipse ? [] : [4, 6]);
  context.beginPath();
  context.moveTo(...start);
  context.lineTo(...end);
  context.stroke();
  context.setLineDash([]);
  if (!arc.ellipse) return;
  const [longer, shorter, angle] = arc.ellipse;
  ellipse(context, camera, middle(arc), [longer * factor, shorter * factor, angle], 1);
  context.globalAlpha = 0.3;
  context.fill();
  context.globalAlpha = 1;
  context.lineWidth = 1;
  context.stroke();
}

/** Where an area or an arc is, in metres. */
export function middle(thing) {
  return thing.at ?? [0, 1].map((k) => (thing.ends[0][k] + thing.ends[1][k]) / 2);
}

function drawArea(context, camera, area, here) {
  const [u, v] = camera.toScreen(area.at);
  context.font = "600 12px system-ui, sans-serif";
  const radius = Math.max(9, context.measureText(area.area).width / 2 + 4);
  context.beginPath();
  context.arc(u, v, radius, 0, 2 * Math.PI);
  context.fillStyle = themed(here ? "--here" : "--card");
  context.fill();
  context.strokeStyle = themed(here ? "--here" : "--area");
  context.lineWidth = 2;
  context.stroke();
  context.fillStyle = themed(here ? "--card" : "--ink");
  context.textAlign = "center";
  context.textBaseline = "middle";
  context.fillText(area.area, u, v + 0.5);
}

function drawRobot(context, camera, robot) {
  const [x, y] = robot.pose;
  const paint = themed("--robot");
  context.fillStyle = context.strokeStyle = paint;
  if (robot.ellipse) {
    ellipse(context, camera, [x, y], robot.ellipse);
    context.globalAlpha = 0.18;
    context.fill();
    context.globalAlpha = 0.7;
    context.lineWidth = 1;
    context.stroke();
    context.globalAlpha = 1;
  }
  drawArrow(context, camera, robot.pose, paint);
}

/** An arrow at a pose, with a name beside it where one is given. */
function drawArrow(context, camera, pose, paint, name = "") {
  const [u, v] = camera.toScreen(pose);
  const size = Math.min(16, Math.max(10, 0.45 * camera.scale));
  context.fillStyle = paint;
  context.save();
  context.translate(u, v);
  context.rotate(-pose[2]);
  context.beginPath();
  context.moveTo(size, 0);
  context.lineTo(-0.7 * size, 0.65 * size);
  context.lineTo(-0.35 * size, 0);
  context.lineTo(-0.7 * size, -0.65 * size);
  context.closePath();
  context.fill();
  context.strokeStyle = themed("--card");
  context.lineWidth = 1.5;
  context.stroke();
  context.restore();
  if (!name) return;
  context.font = "600 12px system-ui, sans-serif";
  context.textAlign = "center";
  context.textBaseline = "top";
  context.fillStyle = paint;
  context.fillText(name, u, v + size);
}

/** Seconds from the first event to each; stamps may jump back, as where a bag begins anew. */
export function seconds(events) {
  let sum = 0;
  return events.map((event, k) => (sum += k ? Math.max(0, event.time - events[k - 1].time) : 0));
}

/** Draw the course of the probabilities: a stack for every event, from it to the next. Returns the number of events. */
export function drawCourse(canvas, events) {
  const { context, width, height } = prepared(canvas);
  context.fillStyle = themed("--ground");
  context.fillRect(0, 0, width, height);
  const times = seconds(events);
  const span = Math.max(times.at(-1) ?? 0, 1);
  const at = (k) => (k < times.length ? Math.round((times[k] / span) * (width - 3)) : width);
  events.forEach((event, k) => {
    let top = height;
    // By number, so that the band of a hypothesis stays where it is.
    for (const [hypothesis, , probability] of [...event.hypotheses].sort((one, other) => one[0] - other[0])) {
      const size = probability * height;
      context.fillStyle = colour(hypothesis);
      context.fillRect(at(k), top - size, Math.max(at(k + 1) - at(k), 1), size);
      top -= size;
    }
  });
  return events.length;
}
