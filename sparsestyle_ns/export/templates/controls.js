// Mouse, fingers, keys and the panel: what they do to the stage.

const DEGREES_PER_HEIGHT = 180;
const KEY_DEGREES = 5;
const KEY_STEP = 0.1;

const element = (id) => document.getElementById(id);

/** One pointer turns the camera, two that spread or close zoom, and so does the wheel. */
function followPointers(stage) {
  const pointers = new Map();
  const spread = () => {
    const [a, b] = [...pointers.values()];
    return Math.hypot(a.x - b.x, a.y - b.y);
  };
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
  });
  canvas.addEventListener("pointermove", (event) => {
    const before = pointers.get(event.pointerId);
    if (!before) return;
    const apart = pointers.size === 2 ? spread() : 0;
    pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    const degrees = DEGREES_PER_HEIGHT / window.innerHeight;
    if (pointers.size === 1) {
      stage.move(-degrees * (event.clientX - before.x), degrees * (event.clientY - before.y), 1);
    } else if (pointers.size === 2) {
      stage.move(0, 0, apart / Math.max(spread(), 1));
    }
  });
  for (const name of ["pointerup", "pointercancel"]) {
    canvas.addEventListener(name, (event) => pointers.delete(event.pointerId));
  }
  canvas.addEventListener(
    "wheel",
    (event) => {
      event.preventDefault();
      const pixels = event.deltaY * (event.deltaMode === WheelEvent.DOM_DELTA_PIXEL ? 1 : 30);
      stage.move(0, 0, Math.exp(0.001 * pixels));
    },
    { passive: false },
  );
}

/** Sliders of the look; a function that moves one by a step. */
function connectSliders(stage) {
  const sliders = ["strength", "geometry", "blend"].map(element).filter(Boolean);
  for (const slider of sliders) {
    slider.value = stage.look[slider.id];
    const tell = () => slider.parentElement.querySelector("output")?.replaceChildren(Number(slider.value).toFixed(2));
    slider.addEventListener("input", () => {
      tell();
      stage.change({ [slider.id]: Number(slider.value) });
    });
    tell();
  }
  return (id, step) => {
    element(id).value = Number(element(id).value) + step;
    element(id).dispatchEvent(new Event("input"));
  };
}

/** The line between before and after, which is dragged or moved by arrow keys; a function that shows or hides it. */
function connectDivider(stage) {
  const divider = element("divider");
  const put = (share) => {
    const at = clamp(share, [0, 1]);
    divider.style.left = `${at * canvas.clientWidth}px`;
    divider.setAttribute("aria-valuenow", Math.round(100 * at));
    stage.change({ divider: at });
  };
  divider.addEventListener("pointerdown", (event) => divider.setPointerCapture(event.pointerId));
  divider.addEventListener("pointermove", (event) => {
    if (divider.hasPointerCapture(event.pointerId)) put(event.clientX / canvas.clientWidth);
  });
  divider.addEventListener("keydown", (event) => {
    const step = { ArrowLeft: -0.05, ArrowRight: 0.05 }[event.key];
    if (step) put(stage.look.divider + step);
  });
  window.addEventListener("resize", () => stage.look.divider !== null && put(stage.look.divider));
  return () => {
    divider.hidden = !divider.hidden;
    element("compare").setAttribute("aria-pressed", String(!divider.hidden));
    if (divider.hidden) stage.change({ divider: null });
    else put(0.5);
  };
}

async function savePicture(stage) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(await stage.picture());
  link.download = scene.file_name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 60_000);
}

function toggleFullScreen() {
  if (document.fullscreenElement) document.exitFullscreen();
  else document.documentElement.requestFullscreen();
}

/** What each key does; the page lists them. */
function connectKeys(actions) {
  const belongsTo = ({ target, key }) => {
    if (target.matches?.("input, [role=slider]")) return true;
    return target.matches?.("button, summary") && (key === " " || key === "Enter");
  };
  const press = (event) => {
    const action = actions[event.key.length === 1 ? event.key.toLowerCase() : event.key];
    if (!action || event.ctrlKey || event.metaKey || event.altKey || belongsTo(event)) return;
    event.preventDefault();
    action();
  };
  window.addEventListener("keydown", press, true); // whatever has the focus
}

function connectControls(stage) {
  const nudge = connectSliders(stage);
  const compare = connectDivider(stage);
  const fly = () => (stage.isFlying ? stage.pause() : stage.play());
  const play = element("play");
  stage.onFlight = () => {
    play.setAttribute("aria-pressed", String(stage.isFlying));
    play.textContent = stage.isFlying ? "Pause" : "Play";
  };
  const buttons = { compare, play: fly, next: () => stage.next(), save: () => savePicture(stage), full: toggleFullScreen };
  for (const [id, action] of Object.entries(buttons)) element(id)?.addEventListener("click", action);
  connectKeys({
    ArrowLeft: () => stage.move(KEY_DEGREES, 0, 1),
    ArrowRight: () => stage.move(-KEY_DEGREES, 0, 1),
    ArrowUp: () => stage.move(0, KEY_DEGREES, 1),
    ArrowDown: () => stage.move(0, -KEY_DEGREES, 1),
    "+": () => stage.move(0, 0, 0.9),
    "-": () => stage.move(0, 0, 1.1),
    "[": () => nudge("strength", -KEY_STEP),
    "]": () => nudge("strength", KEY_STEP),
    ",": () => nudge("geometry", -KEY_STEP),
    ".": () => nudge("geometry", KEY_STEP),
    ...(element("blend") && { ";": () => nudge("blend", -KEY_STEP), "'": () => nudge("blend", KEY_STEP) }),
    ...(play && { " ": fly }),
    b: compare, n: buttons.next, s: buttons.save, f: toggleFullScreen,
  });
  followPointers(stage);
  window.addEventListener("resize", () => stage.show(true));
  if (window.innerWidth < 640) element("panel").open = false;
}
