// The layers of the plan: each with its sign in the legend, and a box to show or hide it.

const LAYERS = [
  ["map", "Map", "--wall", "square"],
  ["walls", "Walls of keyframes", "--wall", "dots"],
  ["path", "Path, corrected", "--path", "line"],
  ["areas", "Areas", "--area", "ring"],
  ["arcs", "Arcs", "--arc", "line"],
  ["closures", "Closures", "--closure", "line"],
  ["candidates", "Not decided yet", "--closure", "dashes"],
  ["covariances", "Uncertainty, 95 %", "--area", "disc"],
  ["scan", "Scan", "--scan", "dots"],
  ["particles", "Particles", "--particle", "dots"],
  ["goals", "Goals", "--goal", "ring"],
  ["marks", "Marks", "--mark", "square"],
  ["landmarks", "Landmarks: corners, openings", "--landmark", "corner"],
  ["rooms", "Room names", "--ink", "tag"],
  ["others", "Robot under other hypotheses", "--soft", "arrow"],
];

/** Which layers are shown; {name: true or false}. */
export const visible = Object.fromEntries(LAYERS.map(([name]) => [name, true]));

/** Fill the legend; a change of a box calls back. */
export function makeLegend(list, onChange) {
  for (const [name, title, paint, sign] of LAYERS) {
    const row = list.appendChild(document.createElement("li"));
    const label = row.appendChild(document.createElement("label"));
    const box = label.appendChild(Object.assign(document.createElement("input"), { type: "checkbox", checked: true }));
    box.dataset.layer = name;
    const mark = label.appendChild(document.createElement("i"));
    mark.className = sign;
    mark.style.setProperty("--sign", `var(${paint})`);
    label.append(title);
    box.addEventListener("change", () => {
      visible[name] = box.checked;
      onChange();
    });
  }
}

/** Gray out the layers of which nothing came, since no topic has it yet or it is elsewhere shown. */
export function markEmpty(list, drawn) {
  for (const box of list.querySelectorAll("input")) {
    box.closest("li").classList.toggle("empty", visible[box.dataset.layer] && !drawn[box.dataset.layer]);
  }
}
