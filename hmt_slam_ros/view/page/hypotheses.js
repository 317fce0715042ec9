// The hypotheses: bars to select one, and in words what speaks for and against it.

import { percent } from "./chart.js";
import { colour, themed } from "./draw.js";

/** What the page calls a hypothesis. */
export function nameOf([hypothesis, area, , lost]) {
  return `${lost ? "Anywhere" : `Area ${area}`} #${hypothesis}`;
}

/** A bar for every hypothesis of an event; a click selects one. */
export function fillBars(list, event, selected, onSelect) {
  if (!event) {
    list.replaceChildren();
    return;
  }
  const seen = event.hypotheses.reduce((sum, leaf) => sum + leaf[2], 0);
  const rows = event.hypotheses.map((leaf) => {
    const row = bar(leaf[3] ? "Anywhere" : `Area ${leaf[1]}`, `#${leaf[0]}`, leaf[2], colour(leaf[0]), "button");
    row.firstChild.setAttribute("aria-pressed", String(leaf[0] === selected));
    row.firstChild.title = `Show the map of hypothesis #${leaf[0]}`;
    row.firstChild.dataset.hypothesis = leaf[0];
    row.firstChild.addEventListener("click", () => onSelect(leaf[0]));
    return row;
  });
  if (seen < 0.995) rows.push(bar("Not examined", "", 1 - seen, themed("--soft"), "div"));
  const focused = document.activeElement?.dataset?.hypothesis;
  list.replaceChildren(...rows);
  if (focused) list.querySelector(`[data-hypothesis="${focused}"]`)?.focus();
}

function bar(name, number, probability, paint, kind) {
  const row = document.createElement("li");
  const line = row.appendChild(document.createElement(kind));
  line.className = "bar";
  const [label, track, share] = ["span", "span", "span"].map((tag) => line.appendChild(document.createElement(tag)));
  label.append(name, " ", Object.assign(document.createElement("small"), { textContent: number }));
  track.className = "track";
  const fill = track.appendChild(document.createElement("i"));
  fill.style.setProperty("--bar", paint);
  fill.style.width = `${(100 * probability).toFixed(1)}%`;
  share.textContent = percent(probability);
  return row;
}

/**
 * Say what speaks for and against a hypothesis, from the section "evidence".
 * Closures that the most probable one has and it lacks are pairs of areas.
 */
export function tellReasons(box, hypothesis, event, evidence, lacking) {
  const leaf = event?.hypotheses.find(([number]) => number === hypothesis);
  box.hidden = !leaf || (event.hypotheses.length === 1 && !evidence?.[hypothesis]);
  if (box.hidden) {
    box.replaceChildren();
    return;
  }
  const title = document.createElement("p");
  title.append(strong(nameOf(leaf), colour(hypothesis)), ` now ${percent(leaf[2])}`);
  const rows = (evidence?.[hypothesis] ?? []).map(stepRow);
  const missing = lacking.map(([a, b]) => line("con", `does not close ${a} with ${b}, as the most probable one does`));
  const nothing = rows.length + missing.length ? [] : [line("", "All hypotheses agree so far on what this one says.")];
  const list = document.createElement("ul");
  list.append(...rows, ...missing, ...nothing);
  box.replaceChildren(title, list);
}

/** List what people stated about places, each with the probability that it is true. */
export function tellStatements(list, statements) {
  list.replaceChildren(...(statements ?? []).map(([text, probability]) => line("", `${text}: ${percent(probability)}`)));
}

function stepRow({ title, probability, pro, con }) {
  const row = line("step", `${title}, ${percent(probability)} then`);
  const list = row.appendChild(document.createElement("ul"));
  list.append(...pro.map((text) => line("pro", text)), ...con.map((text) => line("con", text)));
  return row;
}

function line(kind, text) {
  return Object.assign(document.createElement("li"), { className: kind, textContent: text });
}

function strong(text, paint) {
  const element = Object.assign(document.createElement("strong"), { textContent: text, className: "own" });
  element.style.setProperty("--bar", paint);
  return element;
}
