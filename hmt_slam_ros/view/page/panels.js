// The panels beside the plan: robots of the team, nodes, topics, and what happened.

import { robotColour } from "./draw.js";

const $ = (name) => document.getElementById(name);

/** Write a text where it is another one. */
export function text(element, content) {
  if (element.textContent !== content) element.textContent = content;
}

/** A row for every other robot of the team. */
export function tellRobots(robots) {
  $("team").hidden = robots.length === 0;
  $("robots").replaceChildren(...robots.map(robotRow));
}

function robotRow({ name, joined, verdict, probability, apart }, place) {
  const row = document.createElement("li");
  const [dot, label, answer] = ["span", "span", "small"].map((kind) => document.createElement(kind));
  dot.className = "dot";
  row.style.setProperty("--robot-colour", joined ? robotColour(place) : "var(--line)");
  label.textContent = name;
  const best = probability === undefined ? "" : `, best placement ${(100 * probability).toFixed(1)} %`;
  if (verdict === null) answer.textContent = joined ? "joined by others" : "not compared yet";
  else if (joined) answer.textContent = verdict === "joined" ? `joined, ${(100 * probability).toFixed(1)} %` : `joined by others${best}`;
  else answer.textContent = `${verdict}${best}, apart ${(100 * apart).toFixed(1)} %`;
  row.append(dot, label, answer);
  return row;
}

let known = null; // the rows of before

export function tellNodes(nodes) {
  known = nodes;
  const box = $("nodes");
  nodes.forEach((node, k) => {
    const row = box.children[k] ?? box.appendChild(emptyNode());
    row.dataset.level = node.level;
    text(row.querySelector(".name"), node.name);
    text(row.querySelector(".figures"), figures(node));
    text(row.querySelector(".said"), node.message === "running" ? "" : node.message);
    if (row.open) fillTable(row.querySelector("tbody"), Object.entries(node.values));
  });
  while (box.children.length > nodes.length) box.lastChild.remove();
}

function emptyNode() {
  const row = document.createElement("details");
  row.innerHTML = '<summary><span class="dot"></span><span class="name"></span><span class="figures"></span>'
    + '<span class="said"></span></summary><table><tbody></tbody></table>';
  row.addEventListener("toggle", () => known && tellNodes(known));
  return row;
}

// What a node's rate is about: the first of these that it tells.
const RATES = {
  "received Scan a second": "scans/s",
  "sent Scan a second": "scans/s",
  "received Odometry a second": "odometry/s",
  "received Keyframe a second": "keyframes/s",
};

function figures({ load, values }) {
  const rate = Object.keys(RATES).find((name) => name in values);
  const waiting = Number(values["waiting scans"] ?? 0) + Number(values["waiting for their turn"] ?? 0);
  const dropped = Number(values["dropped scans"] ?? 0);
  return [
    rate ? `${values[rate]} ${RATES[rate]}` : "",
    load === undefined ? "" : `${Math.round(100 * load)} % busy`,
    values["effective samples"] ? `${values["effective samples"]} samples` : "",
    waiting ? `${waiting} waiting` : "",
    dropped ? `${dropped} dropped` : "",
    values.memory ?? "",
  ].filter(Boolean).join(" · ");
}

export function tellTopics(topics) {
  const silent = topics.filter(({ age }) => age === null).length;
  text($("silent"), silent ? `${silent} silent so far` : "all were heard");
  fillTable($("topics"), topics.map(({ topic, from, age }) =>
    [`${topic}, from ${from}`, age === null ? "silent" : age < 2 ? "now" : `${age} s ago`]));
}

/** List what happened to the nodes, the newest first. */
export function tellIncidents(incidents) {
  const rows = incidents.map(({ time, node, text: sentence }) =>
    [new Date(1000 * time).toLocaleTimeString([], { hour12: false }), `${node}: ${sentence}`]);
  text($("newest"), rows.length ? `${rows[0][0]}, ${incidents[0].node}` : "nothing");
  fillTable($("incidents"), rows);
}

function fillTable(body, rows) {
  rows.forEach((cells, k) => {
    const row = body.rows[k] ?? body.insertRow();
    cells.forEach((content, column) => text(row.cells[column] ?? row.insertCell(), String(content)));
  });
  while (body.rows.length > rows.length) body.deleteRow(-1);
}
