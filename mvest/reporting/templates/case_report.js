(() => {
  const canvas = document.querySelector("#valve"), gl = canvas.getContext("webgl2");
  if (!gl) return;
  const shapes = JSON.parse(document.querySelector("#shapes").textContent);
  const buttons = [...document.querySelectorAll("#states button")];
  const program = gl.createProgram();
  const add = (kind, source) => {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, `#version 300 es\nprecision highp float;\n${source}`);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
  };
  // Positions in mm, seen by an eye at infinity; lines and points lie a little nearer.
  add(gl.VERTEX_SHADER, `in vec3 place, colour; uniform mat3 turn; uniform vec3 middle; uniform vec2 scale;
    uniform float lift; out vec3 seen, paint;
    void main() {
      seen = turn * (place - middle); paint = colour;
      gl_Position = vec4(scale * seen.xy, -0.002 * (seen.z + lift), 1.0); gl_PointSize = 7.0;
    }`);
  // Both sides are lit alike.
  add(gl.FRAGMENT_SHADER, `in vec3 seen, paint; uniform float lift; out vec4 pixel;
    void main() {
      vec3 normal = normalize(cross(dFdx(seen), dFdy(seen)));
      float light = lift > 0.0 ? 1.0 : 0.55 + 0.45 * abs(dot(normal, vec3(-0.40, 0.45, 0.80)));
      pixel = vec4(light * paint, 1.0);
    }`);
  gl.linkProgram(program);
  gl.useProgram(program);
  gl.enable(gl.DEPTH_TEST);
  gl.clearColor(1, 1, 1, 1);
  const uniform = (name) => gl.getUniformLocation(program, name);
  const bytes = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const load = (name, data, type, normalised) => {
    const at = gl.getAttribLocation(program, name);
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, data, gl.STATIC_DRAW);
    gl.enableVertexAttribArray(at);
    gl.vertexAttribPointer(at, 3, type, normalised, 0, 0);
  };
  const parts = shapes.map((shape) => ["triangles", "lines", "points"].map((kind) => {
    const [places, colours] = shape[kind].map(bytes), array = gl.createVertexArray();
    gl.bindVertexArray(array);
    load("place", places, gl.FLOAT, false);
    load("colour", colours, gl.UNSIGNED_BYTE, true);
    return { array, mode: gl[kind.toUpperCase()], count: colours.length / 3, lift: kind === "triangles" ? 0 : 0.3 };
  }));
  // What is open or closed turns about the same point, and all of it is in sight.
  const all = shapes.flatMap((shape) => [...new Float32Array(bytes(shape.triangles[0]).buffer),
    ...new Float32Array(bytes(shape.points[0]).buffer)]);
  const axis = [0, 1, 2].map((k) => all.filter((_, at) => at % 3 === k));
  const ends = axis.map((values) => [values.reduce((a, b) => Math.min(a, b)), values.reduce((a, b) => Math.max(a, b))]);
  const middle = ends.map(([low, high]) => (low + high) / 2), size = Math.hypot(...ends.map(([low, high]) => high - low));
  let shown = buttons.findIndex((button) => button.ariaPressed === "true"), azimuth = -0.9, elevation = 0.8, zoom = 1;
  const draw = () => {
    canvas.width = canvas.clientWidth * devicePixelRatio;
    canvas.height = canvas.clientHeight * devicePixelRatio;
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    const [ca, sa, ce, se] = [Math.cos(azimuth), Math.sin(azimuth), Math.cos(elevation), Math.sin(elevation)];
    gl.uniformMatrix3fv(uniform("turn"), false, [-sa, -se * ca, ce * ca, ca, -se * sa, ce * sa, 0, ce, se]);
    gl.uniform3fv(uniform("middle"), middle);
    const least = Math.min(canvas.width, canvas.height), reach = 2 * zoom / size * least;
    gl.uniform2f(uniform("scale"), reach / canvas.width, reach / canvas.height);
    for (const { array, mode, count, lift } of parts[shown]) {
      gl.bindVertexArray(array);
      gl.uniform1f(uniform("lift"), lift);
      gl.drawArrays(mode, 0, count);
    }
    canvas.dataset.shown = shapes[shown].label;
  };
  buttons.forEach((button, number) => button.addEventListener("click", () => {
    for (const other of buttons) other.ariaPressed = other === button;
    shown = number;
    draw();
  }));
  canvas.addEventListener("pointermove", (event) => {
    if (!event.buttons) return;
    azimuth -= 0.01 * event.movementX;
    elevation = Math.max(-1.57, Math.min(1.57, elevation + 0.01 * event.movementY));
    draw();
  });
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    zoom *= Math.exp(-0.001 * event.deltaY);
    draw();
  });
  addEventListener("resize", draw);
  draw();
})();
