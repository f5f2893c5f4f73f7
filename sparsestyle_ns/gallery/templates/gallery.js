for (const slider of document.querySelectorAll(".compare")) {
  const range = slider.querySelector("input");
  const show = () => slider.style.setProperty("--at", range.value + "%");
  const follow = (event) => {
    const box = slider.getBoundingClientRect();
    range.value = 100 * (event.clientX - box.left) / box.width;
    show();
  };
  slider.addEventListener("pointerdown", (event) => { slider.setPointerCapture(event.pointerId); follow(event); });
  slider.addEventListener("pointermove", (event) => { if (event.buttons) follow(event); });
  range.addEventListener("input", show);
  show();
}
if (matchMedia("(prefers-reduced-motion: reduce)").matches) {
  for (const video of document.querySelectorAll("video")) { video.autoplay = false; video.pause(); }
}
