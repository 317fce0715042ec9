// The plan on its canvas: map, areas, arcs, robot, and the layers above.

import { compose } from "./scene.js";

const GOLDEN = 0.6180339887498949;
const FACTORS = [1, 2, 5, 10, 20, 50, 100];
const VISIBLE = 14; // px, of the largest ellipse of an arc

/** The colour of a hypothesis, as in pmf.png: neighbouring numbers are far apart. */
export function colour(hypothesis) {
  const hue = ((0.58 + hypothesis * GOLDEN) % 1) * 360;
  return `hsl(${hue.toFixed(1)} 74% ${hypothesis % 2 ? 49 : 37}%)`;
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

/**
 * Draw the plan: a scene, and the layers that are visible above it.
 * Returns what was drawn, and where: counts by layer, {robot, factor, middle, spots, team}.
 */
export function drawPlan(canvas, camera, state, { scene, picture, walls, team, paint, others, robot, isLive, visible }) {
  const { context, width, height } = prepared(canvas);
  [camera.width, camera.height] = [width, height];
  context.fillStyle = themed("--unknown");
  context.fillRect(0, 0, width, height);
  const drawn = { factor: 1, map: false, spots: [], middle: [camera.x, camera.y], robot: null };
  if (visible.map && state.map && picture) {
    drawPicture(context, camera, state.map, picture);
    drawn.map = true;
  }
  drawn.walls = visible.walls && walls ? walls.draw(context, camera, scene, themed("--wall")) : 0;
  drawn.team = team.map((other) => drawOther(context, camera, other));
  drawn.path = visible.path ? drawPath(context, camera, scene.path, paint) : 0;
  drawn.landmarks = visible.landmarks && isLive ? drawLandmarks(context, camera, state.landmarks ?? {}) : 0;
  drawGraph(context, camera, scene, paint, visible, drawn);
  drawLayers(context, camera, state, scene, robot, isLive, visible, drawn);
  drawn.others = visible.others ? others.length : 0;
  if (visible.others) others.forEach(({ pose, paint: own, name }) => drawArrow(context, camera, pose, own, name));
  if (robot) {
    drawRobot(context, camera, robot, paint, visible.covariances);
    drawn.robot = robot.pose;
  }
  return drawn;
}

function drawPicture(context, camera, map, picture) {
  const [u, v] = camera.toScreen([map.origin[0], map.origin[1] + map.size[1]]);
  context.imageSmoothingEnabled = camera.scale * (map.size[0] / picture.width) < 1;
  context.drawImage(picture, u, v, map.size[0] * camera.scale, map.size[1] * camera.scale);
}

function drawGraph(context, camera, scene, paint, visible, drawn) {
  drawn.factor = factorOf(scene, camera);
  const isShown = (arc) => visible[arc.closure ? "closures" : "arcs"] && (visible.candidates || !arc.candidate);
  const arcs = scene.arcs.filter(isShown);
  arcs.forEach((arc) => drawArc(context, camera, arc, visible.covariances ? drawn.factor : 0, paint));
  if (visible.areas) {
    if (visible.covariances) scene.areas.forEach((area) => drawSpread(context, camera, area.at, area.ellipse, themed("--area")));
    scene.areas.forEach((area) => drawArea(context, camera, area, area.area === scene.area));
  }
  drawn.areas = visible.areas ? scene.areas.length : 0;
  drawn.arcs = arcs.length;
  drawn.closures = arcs.filter((arc) => arc.closure).length;
  drawn.candidates = arcs.filter((arc) => arc.candidate).map((arc) => arc.numbers);
  drawn.covariances = visible.covariances ? arcs.filter((arc) => arc.ellipse).length : 0;
  drawn.spots = scene.areas.map(({ area, at }) => ({ area, at: camera.toScreen(at).map(Math.round) }));
}

/** Rooms of the most probable map of now; scan, particles and goals, of a robot that is known; marks of any map. */
function drawLayers(context, camera, state, scene, robot, isLive, visible, drawn) {
  const live = robot?.live ? robot.pose : null;
  const scan = visible.scan && live ? state.scan ?? [] : [];
  for (let k = 0; k < scan.length; k += 2) drawDot(context, camera, compose(live, [scan[k], scan[k + 1]]), themed("--scan"), 1.5);
  const particles = visible.particles && live ? state.particles ?? [] : [];
  particles.forEach((pose) => drawDot(context, camera, pose, themed("--particle"), 2));
  const goals = [["goal", "Goal"], ["look", "A look decides"]].flatMap(([name, title]) =>
    visible.goals && live && state[name] && Math.hypot(state[name][0] - live[0], state[name][1] - live[1]) > 0.5
      ? [[state[name], title]] : []);
  goals.forEach(([pose, title]) => drawSign(context, camera, pose, themed("--goal"), title, true));
  const areas = new Map(scene.areas.map((area) => [area.area, area.pose]));
  const marks = Object.entries(visible.marks ? state.marks ?? {} : {}).filter(([, mark]) => areas.has(mark.area));
  marks.forEach(([name, mark]) => drawSign(context, camera, compose(areas.get(mark.area), mark.at), themed("--mark"), name, false));
  drawn.cards = drawRooms(context, camera, visible.rooms && isLive ? state.rooms ?? [] : []);
  Object.assign(drawn, { rooms: drawn.cards.length, scan: scan.length / 2, particles: particles.length, goals: goals.length, marks: marks.length });
}

const LEAST = 5; // px, of a wall of a corner

/** Corners as two lines along their walls, openings as a line between two dots; returns how many. */
function drawLandmarks(context, camera, { corners = [], convex_corners: convex = [], openings = [] }) {
  const at = (flat, k) => camera.toScreen([flat[k] / 100, flat[k + 1] / 100]);
  context.strokeStyle = context.fillStyle = themed("--landmark");
  context.lineWidth = 1.5;
  context.lineCap = "round";
  context.beginPath();
  for (const flat of [corners, convex]) {
    for (let k = 0; k < flat.length; k += 4) {
      const [[u, v], [end, other]] = [at(flat, k), at(flat, k + 2)];
      const factor = Math.max(1, LEAST / Math.max(0.1, Math.hypot(end - u, other - v)));
      context.moveTo(u, v);
      context.lineTo(u + factor * (end - u), v + factor * (other - v));
    }
  }
  for (let k = 0; k < openings.length; k += 4) {
    const jambs = [at(openings, k), at(openings, k + 2)];
    context.moveTo(...jambs[0]);
    context.lineTo(...jambs[1]);
    jambs.forEach(([u, v]) => context.fillRect(u - 1.5, v - 1.5, 3, 3));
  }
  context.stroke();
  context.lineCap = "butt";
  return (corners.length + convex.length) / 8 + openings.length / 4;
}

const TAG = 20; // px, height of a name on its card
const SHIFTS = [0, 1.2, 2.4, -1.2, -2.4].map((rows) => rows * TAG);

/** Names on cards in the middle of their rooms, or beside that, away from the other rooms; returns the cards. */
function drawRooms(context, camera, rooms) {
  context.font = "600 12px system-ui, sans-serif";
  context.textAlign = "center";
  context.textBaseline = "middle";
  context.lineWidth = 1;
  const cards = [];
  const spots = rooms.map(([name, ...at]) => [name, ...camera.toScreen(at)]);
  const middle = spots.reduce((sum, [, , v]) => sum + v, 0) / spots.length;
  for (const [name, u, v] of spots) {
    const away = v < middle ? -1 : 1;
    const half = context.measureText(name).width / 2 + 6;
    const isFree = (w) => cards.every((card) => Math.abs(card.u - u) > card.half + half || Math.abs(card.v - w) > TAG);
    cards.push({ name, u, v: SHIFTS.map((shift) => v + away * shift).find(isFree) ?? v, half });
    drawCard(context, cards.at(-1), v);
  }
  return cards;
}

/** A card with a line to its room, where it is beside that. */
function drawCard(context, { name, u, v, half }, room) {
  context.strokeStyle = themed("--ink");
  context.beginPath();
  context.moveTo(u, room);
  context.lineTo(u, v);
  context.stroke();
  context.beginPath();
  context.roundRect(u - half, v - TAG / 2, 2 * half, TAG, 5);
  context.fillStyle = themed("--card");
  context.fill();
  context.stroke();
  context.fillStyle = themed("--ink");
  context.fillText(name, u, v + 0.5);
}

function drawDot(context, camera, at, paint, radius) {
  const [u, v] = camera.toScreen(at);
  context.fillStyle = paint;
  context.fillRect(u - radius, v - radius, 2 * radius, 2 * radius);
}

/** A ring or a square with a name below. */
function drawSign(context, camera, at, paint, name, isRound) {
  const [u, v] = camera.toScreen(at);
  context.strokeStyle = context.fillStyle = paint;
  context.lineWidth = 2.5;
  context.beginPath();
  if (isRound) context.arc(u, v, 8, 0, 2 * Math.PI);
  else context.rect(u - 5, v - 5, 10, 10);
  context.stroke();
  drawName(context, name, u, v + 11);
}

function drawName(context, name, u, v) {
  context.font = "600 12px system-ui, sans-serif";
  context.textAlign = "center";
  context.textBaseline = "top";
  context.lineWidth = 3;
  context.strokeStyle = themed("--card");
  context.strokeText(name, u, v);
  context.fillStyle = themed("--ink");
  context.fillText(name, u, v);
}

/** An ellipse with a faint inside. */
function drawSpread(context, camera, at, half, paint) {
  if (!half) return;
  ellipse(context, camera, at, half);
  context.fillStyle = context.strokeStyle = paint;
  context.globalAlpha = 0.15;
  context.fill();
  context.globalAlpha = 0.6;
  context.lineWidth = 1;
  context.stroke();
  context.globalAlpha = 1;
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

function drawPath(context, camera, path, paint) {
  context.lineJoin = "round";
  context.beginPath();
  path.forEach((point, k) => {
    const [u, v] = camera.toScreen(point);
    const jump = k === 0 || Math.hypot(point[0] - path[k - 1][0], point[1] - path[k - 1][1]) > 5;
    if (jump) context.moveTo(u, v);
    else context.lineTo(u, v);
  });
  if (paint) {
    // In the colour of a hypothesis, which may be as dark as the ground.
    [context.strokeStyle, context.lineWidth] = [themed("--ink"), 4];
    context.globalAlpha = 0.45;
    context.stroke();
    context.globalAlpha = 1;
  }
  [context.strokeStyle, context.lineWidth] = [paint ?? themed("--path"), paint ? 2 : 1.5];
  context.stroke();
  return path.length;
}

function ellipse(context, camera, at, [longer, shorter, angle], least = 0) {
  const [u, v] = camera.toScreen(at);
  const half = [longer, shorter].map((length) => Math.max(least, length * camera.scale));
  context.beginPath();
  context.ellipse(u, v, ...half, -angle, 0, 2 * Math.PI);
}

/** An arc that not all hypotheses have is dashed; one that could lie anyhow is dotted. */
function drawArc(context, camera, arc, factor, paint) {
  const [start, end] = arc.ends.map((point) => camera.toScreen(point));
  const own = arc.candidate && paint ? paint : themed(arc.closure ? "--closure" : "--arc");
  context.strokeStyle = context.fillStyle = own;
  context.lineWidth = arc.closure ? 2.5 : 1.5;
  if (arc.candidate) context.setLineDash([9, 6]);
  else if (!arc.ellipse && !paint) context.setLineDash([2, 5]);
  context.beginPath();
  context.moveTo(...start);
  context.lineTo(...end);
  context.stroke();
  context.setLineDash([]);
  if (!arc.ellipse || !factor) return;
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

function drawRobot(context, camera, robot, paint, hasSpread) {
  const own = paint ?? themed("--robot");
  if (hasSpread) drawSpread(context, camera, robot.pose, robot.ellipse, own);
  drawArrow(context, camera, robot.pose, own);
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
  if (name) drawName(context, name, u, v + size);
}
