// Pictures that open large, sliders that wipe between two, and everything open in print.
const dialog = document.querySelector("dialog");
const large = dialog.querySelector("img");
const thumbs = [...document.querySelectorAll(".thumb")];
let current = 0;

function open(index) {
  current = (index + thumbs.length) % thumbs.length;
  const image = thumbs[current].querySelector("img");
  large.src = image.src;
  large.alt = image.alt;
  dialog.querySelector("output").textContent = thumbs[current].dataset.caption;
  if (!dialog.open) dialog.showModal();
}

thumbs.forEach((thumb, index) => thumb.addEventListener("click", () => open(index)));
dialog.querySelector("[data-step='-1']").addEventListener("click", () => open(current - 1));
dialog.querySelector("[data-step='1']").addEventListener("click", () => open(current + 1));
dialog.addEventListener("keydown", (event) => {
  if (event.key === "ArrowLeft") open(current - 1);
  if (event.key === "ArrowRight") open(current + 1);
});
dialog.addEventListener("click", (event) => event.target === dialog && dialog.close());
document.querySelectorAll(".wipe input").forEach((slider) =>
  slider.addEventListener("input", () =>
    slider.parentElement.style.setProperty("--cut", `${slider.value}%`),
  ),
);
addEventListener("beforeprint", () =>
  document.querySelectorAll("details").forEach((one) => (one.open = true)),
);

// What a term means: under the pointer or the keyboard's focus, until Escape.
const meaning = document.getElementById("meaning");
let explained = null;

function explain(term) {
  explained = term;
  meaning.hidden = !term;
  if (!term) return;
  meaning.textContent = term.getAttribute("aria-description");
  const at = term.getBoundingClientRect();
  const [width, height] = [meaning.offsetWidth, meaning.offsetHeight];
  const below = at.bottom + 6 + height < innerHeight;
  meaning.style.left = `${Math.max(6, Math.min(at.left, innerWidth - width - 6))}px`;
  meaning.style.top = `${below ? at.bottom + 6 : Math.max(6, at.top - height - 6)}px`;
}

for (const name of ["mouseover", "focusin"]) {
  document.addEventListener(name, (event) => {
    const term = event.target.closest(".term");
    if (term) explain(term);
    else if (name === "mouseover" && explained && !event.target.closest("#meaning")) {
      explain(document.activeElement.closest(".term")); // a resting pointer hides no focused one's
    }
  });
}
document.addEventListener("focusout", () => explain(null));
document.addEventListener("keydown", (event) => event.key === "Escape" && explain(null));
addEventListener("scroll", () => explained && explain(explained), { passive: true, capture: true });
