// The panel follows viser's scrubber, the only clock of the page: its time is the value that the slider tells
// assistive technology. A click into a curve is passed on as one on the slider.
"use strict";
(() => {
  const { duration, columns, flights } = JSON.parse(document.getElementById("flights").textContent);
  const dashboard = document.querySelector(".dashboard");
  const curves = dashboard.querySelector(".curves");
  const START_UP = 30000; // ms after which a viewer that is not there has failed
  let shown = -1;

  const slider = () => document.querySelector("#root [role=slider]");

  function show(time) {
    shown = time;
    dashboard.style.setProperty("--now", Math.min(time / duration, 1));
    dashboard.querySelector("[data-time]").textContent = `${Math.min(time, duration).toFixed(2)} s`;
    flights.forEach((flight, index) => {
      const row = Math.min(Math.floor(time / flight.control_dt + 1e-6), flight.words.length - 1);
      const view = dashboard.querySelector(`.view-${index}`);
      view?.style.setProperty("--column", row % columns);
      view?.style.setProperty("--row", Math.floor(row / columns));
      dashboard.querySelectorAll(`[data-words="${index}"]`).forEach((cell, which) => {
        cell.textContent = flight.words[row][which];
      });
      dashboard.querySelectorAll(`[data-value="${index}"]`).forEach((cell) => {
        const value = flight.values[cell.dataset.of][row]; // none of a step that was not made, or of a lost state
        cell.textContent = value == null ? "–" : value.toFixed(2);
      });
    });
  }

  function press(time) {
    const thumb = slider();
    const track = thumb.closest(".mantine-Slider-trackContainer");
    const { left, width, top, height } = track.getBoundingClientRect();
    const x = left + (width * time) / Number(thumb.ariaValueMax);
    const at = { bubbles: true, cancelable: true, button: 0, clientX: x, clientY: top + height / 2 };
    track.dispatchEvent(new PointerEvent("mousedown", at));
    document.dispatchEvent(new MouseEvent("mouseup", at));
  }

  let lookedAt;

  // A press pauses the viewer, but a frame of its playing may still come after it: press until the time stands still.
  function seek(time, before) {
    clearTimeout(lookedAt);
    dashboard.ariaBusy = "true";
    press(time);
    lookedAt = setTimeout(() => requestAnimationFrame(() => {
      const now = slider().ariaValueNow;
      if (now !== before) return seek(time, now);
      dashboard.ariaBusy = "false";
    }), 150);
  }

  function seekHere(event) {
    const curve = curves.querySelector("svg").getBoundingClientRect();
    const share = (event.clientX - curve.left) / curve.width;
    if (share >= 0 && share <= 1 && slider()) seek(share * duration);
  }

  curves.addEventListener("pointerdown", (event) => {
    curves.setPointerCapture(event.pointerId);
    seekHere(event);
  });
  curves.addEventListener("pointermove", (event) => event.buttons && seekHere(event));

  document.addEventListener("keydown", (event) => {
    const step = { ",": -1, ".": 1 }[event.key];
    const typing = event.target instanceof HTMLInputElement;
    if (step && slider() && !typing) seek(Math.min(Math.max(shown + step * flights[0].control_dt, 0), duration));
  });

  function follow() {
    const time = Number(slider()?.ariaValueNow ?? 0);
    if (time !== shown) show(time);
    requestAnimationFrame(follow);
  }

  function begin(since) {
    if (slider()) {
      const asked = Number(new URLSearchParams(location.hash.slice(1)).get("t"));
      if (asked > 0) seek(Math.min(asked, duration)); // page.html#t=3.4
      return follow();
    }
    if (performance.now() - since < START_UP) return setTimeout(() => begin(since), 100);
    const problem = document.createElement("p");
    problem.className = "problem";
    problem.textContent = "The 3-D view did not start: this browser may lack WebGL 2, or be too old.";
    dashboard.prepend(problem);
  }

  show(0);
  begin(performance.now());
})();
