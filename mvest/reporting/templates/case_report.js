document.querySelectorAll("#states button").forEach((button, _, all) => button.addEventListener("click", () => {
  for (const other of all) other.setAttribute("aria-pressed", other === button ? "true" : "false");
  Plotly.restyle("valve", { visible: JSON.parse(button.dataset.shown) });
}));
