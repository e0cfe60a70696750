(function () {
  const visible = {{ scene.visible | tojson }};
  const model = document.getElementById("model"), value = document.getElementById("value");
  function limit() {
    for (const option of value.options) {
      option.disabled = !((model.value + " " + option.value) in visible);
    }
    if (value.selectedOptions[0].disabled) { value.selectedIndex = 0; }
  }
  function show() {
    limit();
    Plotly.restyle("scene", {visible: visible[model.value + " " + value.value]});
  }
  model.addEventListener("change", show);
  value.addEventListener("change", show);
  limit();
})();
