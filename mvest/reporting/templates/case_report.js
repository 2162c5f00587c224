(() => {
  const press = (button) => {
    for (const other of button.parentElement.querySelectorAll("button"))
      other.setAttribute("aria-pressed", other === button ? "true" : "false");
  };
  document.querySelectorAll("#states button").forEach((button) => button.addEventListener("click", () => {
    press(button);
    Plotly.restyle("valve", { visible: JSON.parse(button.dataset.shown) });
  }));
  document.querySelectorAll("#cameras button").forEach((button) => button.addEventListener("click", () => {
    press(button);
    Plotly.relayout("valve", { "scene.camera": JSON.parse(button.dataset.camera) });
  }));
})();
