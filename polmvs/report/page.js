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
