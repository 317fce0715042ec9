// Pointer, wheel and keys on the plan: move, zoom with two fingers, click.

/**
 * Listen to what people do on the plan; calls back {moved, zoomed, turned, wanted(mode), clicked(pixel)}.
 * While the controls wait for a pose, a drag is that pose.
 */
export function listen(plan, camera, { moved, zoomed, turned, wanted, clicked }, controls) {
  const pointers = new Map();
  let travelled = 0;
  plan.addEventListener("pointerdown", (event) => {
    plan.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, [event.offsetX, event.offsetY]);
    travelled = 0;
    controls.begin([event.offsetX, event.offsetY]);
  });
  plan.addEventListener("pointermove", (event) => {
    const before = pointers.get(event.pointerId);
    if (!before) return;
    const now = [event.offsetX, event.offsetY];
    const [du, dv] = [now[0] - before[0], now[1] - before[1]];
    travelled += Math.hypot(du, dv);
    pointers.set(event.pointerId, now);
    if (controls.turn(now)) {
      turned();
      return;
    }
    if (travelled < 4) return;
    const others = [...pointers].filter(([id]) => id !== event.pointerId);
    if (others.length === 1) {
      const [, other] = others[0];
      const ratio = Math.hypot(now[0] - other[0], now[1] - other[1])
        / Math.max(1, Math.hypot(before[0] - other[0], before[1] - other[1]));
      camera.zoom(ratio, other);
    } else {
      camera.move(du, dv);
    }
    moved();
  });
  for (const kind of ["pointerup", "pointercancel"]) {
    plan.addEventListener(kind, (event) => {
      pointers.delete(event.pointerId);
      if (controls.end(kind === "pointerup")) return;
      if (kind === "pointerup" && travelled < 4) clicked([event.offsetX, event.offsetY]);
    });
  }
  plan.addEventListener("wheel", (event) => {
    event.preventDefault();
    camera.zoom(Math.exp(-event.deltaY / 500), [event.offsetX, event.offsetY]);
    zoomed();
  }, { passive: false });
  plan.addEventListener("keydown", ({ key }) => {
    const center = [camera.width / 2, camera.height / 2];
    const steps = { ArrowLeft: [60, 0], ArrowRight: [-60, 0], ArrowUp: [0, 60], ArrowDown: [0, -60] };
    if (key === "+" || key === "-") camera.zoom(key === "+" ? 1.25 : 0.8, center);
    else if (steps[key]) camera.move(...steps[key]);
    if (key === "0" || key === "f") wanted(key === "0" ? "fit" : "follow");
    else if (key === "+" || key === "-" || steps[key]) wanted("free");
  });
}
