// Everything starts here, after the library is unpacked.

// The slider of tau runs down by itself, so that the paths move over V at their time to go.
function playable(root) {
  const button = root.querySelector(".play"), tau = root.querySelector(".tau"), words = button.textContent;
  let timer = null;
  const set = (value) => { tau.value = value; tau.dispatchEvent(new Event("input")); };
  const stop = () => { clearTimeout(timer); timer = null; button.textContent = words; };
  const step = (value) => {
    set(value);
    // The next step waits until this one is drawn.
    timer = setTimeout(() => (value > 0 ? step(value - 1) : stop()), 250);
  };
  button.addEventListener("click", () => {
    if (timer) return stop();
    button.textContent = "Stop";
    step(Number(tau.max));
  });
}

async function begin() {
  await loadLibrary();
  for (const root of document.querySelectorAll(".explorer")) {
    root.querySelector("form").addEventListener("submit", (event) => event.preventDefault());
    await ("line" in dataOf(root) ? exploreLine(root) : explorePlanes(root));
    playable(root);
  }
  document.querySelectorAll(".panels").forEach(drawTraining);
  dark.addEventListener("change", redrawAll);
  const folded = [...document.querySelectorAll("details.printed:not([open])")];
  for (const [event, value] of [["beforeprint", true], ["afterprint", false]]) {
    addEventListener(event, () => {
      printing = value;
      folded.forEach((part) => { part.open = value; });
      redrawAll();
    });
  }
  document.body.dataset.ready = "true";
}

begin().catch((error) => {
  console.error(error);
  const words = document.createElement("p");
  words.className = "warning";
  words.textContent = `The charts could not be drawn: ${error.message}. A browser of 2023 or later is needed.`;
  document.querySelector("main").prepend(words);
});
