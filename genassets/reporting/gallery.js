// The gallery's behaviour. What is shown follows the address: index.html#class=Car&time=day&actor=NAME.
"use strict";
(() => {
  const cards = JSON.parse(document.getElementById("cards").textContent);
  const byName = new Map(cards.map((card) => [card.name, card]));
  const filters = [
    { key: "class", label: "Class", of: (card) => card.actor_class },
    { key: "time", label: "Time", of: (card) => card.time_of_day },
    { key: "origin", label: "Origin", of: (card) => card.origin },
  ];
  const dialog = document.getElementById("closer");
  const stage = document.getElementById("stage");
  const models = new Map();  // name: address of its mesh as a blob

  const element = (tag, properties = {}, ...children) => {
    const made = Object.assign(document.createElement(tag), properties);
    made.append(...children);
    return made;
  };
  const wanted = () => new URLSearchParams(location.hash.slice(1));
  const go = (key, value) => {
    const next = wanted();
    if (value === null) next.delete(key); else next.set(key, value);
    location.hash = next.toString();
  };
  const fitting = () => {
    const now = wanted();
    return cards.filter((card) => filters.every(({ key, of }) => !now.has(key) || of(card) === now.get(key)));
  };
  const metres = (values) => values.map((value) => value.toFixed(2)).join(" × ") + " m";
  const file = (card, name) => `actors/${card.name}/${name}`;

  const makeFilters = () => {
    for (const { key, label, of } of filters) {
      const values = [...new Set(cards.map(of))].filter(Boolean).sort();
      if (values.length < 2) continue;
      const buttons = [null, ...values].map((value) => {
        const button = element("button", { type: "button", textContent: value ?? "all" });
        button.dataset.key = key;
        button.dataset.value = value ?? "";
        button.onclick = () => go(key, value);
        return button;
      });
      document.getElementById("filters").append(element("div", {}, element("span", { textContent: label }), ...buttons));
    }
  };

  const makeActors = () => {
    for (const card of cards) {
      const name = element("strong", { textContent: card.actor_class });
      if (card.origin === "generated") name.append(element("span", { className: "made", textContent: "generated" }));
      const where = [`log ${card.log}`, card.time_of_day].filter(Boolean).join(", ");
      const button = element("button", { type: "button" },
        element("img", { src: file(card, "thumbnail.png"), alt: "", loading: "lazy" }),
        element("div", { className: "under" }, name, element("small", { textContent: metres(card.size) }), element("small", { textContent: where })));
      button.dataset.name = card.name;
      button.onclick = () => go("actor", card.name);
      document.getElementById("actors").append(button);
    }
  };

  const loadScript = (src) => new Promise((resolve, reject) => {
    document.head.append(element("script", { src, onload: resolve, onerror: reject }));
  });
  let viewerLoaded = null;
  const loadViewer = () => (viewerLoaded ??= loadScript("viewer/model-viewer-umd.min.js"));
  // Called by actors/NAME/model.js.
  window.showModel = (name, data) => {
    const bytes = Uint8Array.from(atob(data), (letter) => letter.charCodeAt(0));
    models.set(name, URL.createObjectURL(new Blob([bytes], { type: "model/gltf-binary" })));
  };
  const modelOf = async (card) => {
    if (!models.has(card.name)) await loadScript(file(card, "model.js"));
    return models.get(card.name);
  };

  const showStage = async (card) => {
    document.body.dataset.model = "loading";
    const still = element("img", { src: file(card, "thumbnail.png"), alt: card.actor_class });
    stage.replaceChildren(still);
    if (!card.turns) { document.body.dataset.model = "none"; return; }
    try {
      const [, source] = await Promise.all([loadViewer(), modelOf(card)]);
      if (wanted().get("actor") !== card.name) return;
      const viewer = document.createElement("model-viewer");
      for (const [name, value] of Object.entries({
        "src": source, "alt": `${card.actor_class}, ${metres(card.size)}`, "camera-controls": "", "auto-rotate": "",
        "camera-orbit": "35deg 72deg auto", "shadow-intensity": "0.6", "shadow-softness": "0.9",
        "interaction-prompt": "none", "tone-mapping": "neutral", "environment-image": "neutral", "exposure": "1",
        "min-camera-orbit": "auto 0deg auto", "touch-action": "pan-y",
      })) viewer.setAttribute(name, value);
      viewer.addEventListener("load", () => {
        const size = viewer.getDimensions();
        document.body.dataset.model = [size.x, size.y, size.z].map((side) => side.toFixed(3)).join(" ");
      });
      viewer.addEventListener("error", () => { document.body.dataset.model = "failed"; });
      stage.replaceChildren(viewer, element("p", { textContent: "Drag to turn, scroll to come closer" }));
    } catch (error) {
      document.body.dataset.model = "failed";
      stage.replaceChildren(still, element("p", { textContent: "The mesh could not be loaded" }));
    }
  };

  const factsOf = (card) => {
    const seen = card.observed;
    const lines = [
      ["Box", metres(card.size)],
      ["Log", `${card.log} (${card.source.replace("_", " ")})`],
      ["Time of day", card.time_of_day],
      ["Learned from", `${card.training_views} views`],
      seen && ["Seen in", `${seen.images} images`],
      seen && seen.lidar_points !== null && ["LiDAR returns", seen.lidar_points.toLocaleString("en")],
      ...Object.entries(card.metrics).map(([name, value]) => [
        name.replace("held_out_", "Held-out ").replace("psnr", "PSNR").replace("ssim", "SSIM").replace("lpips", "LPIPS"),
        name.endsWith("psnr") ? `${value.toFixed(1)} dB` : value.toFixed(3)]),
      ["Mesh", `${card.mesh.triangles.toLocaleString("en")} triangles${card.mesh.watertight ? ", watertight" : ""}`],
      card.seed !== null && ["Seed", String(card.seed)],
    ];
    return lines.filter((line) => line && line[1]).flatMap(([name, value]) => [
      element("dt", { textContent: name }), element("dd", { textContent: value })]);
  };

  const showNearest = (card) => {
    const place = document.getElementById("closer-nearest");
    place.replaceChildren();
    if (!card.nearest) return;
    const twin = cards.find((other) => other.actor_id === card.nearest.actor_id && other.log === card.nearest.log && other.origin !== "generated");
    const far = card.nearest.distance === null ? "" : `, distance ${card.nearest.distance.toPrecision(3)}`;
    const text = `${card.nearest.actor_id.slice(0, 8)} of log ${card.nearest.log}${far}`;
    const figure = element("figure");
    if (twin) {
      const link = element("a", { href: "#" }, element("img", { src: file(twin, "thumbnail.png"), alt: text }));
      link.onclick = (event) => { event.preventDefault(); go("actor", twin.name); };
      figure.append(link);
    }
    figure.append(element("figcaption", {}, element("strong", { textContent: "Nearest training actor" }), text));
    place.append(figure);
  };

  const showActor = (card) => {
    document.getElementById("closer-origin").textContent = card.origin;
    document.getElementById("closer-name").replaceChildren(card.actor_class, element("code", { textContent: card.actor_id }));
    document.getElementById("closer-facts").replaceChildren(...factsOf(card));
    showNearest(card);
    const links = [...card.files.filter((name) => name !== "thumbnail.png"), "card.md"];
    document.getElementById("closer-downloads").replaceChildren(...links.map((name) => element("a", {
      href: file(card, name), download: name === "card.md" ? `${card.name}.md` : name,
      textContent: name === "card.md" ? "Card" : name.slice(name.lastIndexOf(".") + 1).toUpperCase() })));
    const licence = card.licence;
    const name = licence.url ? element("a", { href: licence.url, textContent: licence.name }) : licence.name;
    document.getElementById("closer-licence").replaceChildren("Source data: ", name, `. Credit: ${licence.attribution}.`);
    if (!dialog.open) dialog.showModal();
    showStage(card);
  };

  let open = null;
  const update = () => {
    const now = wanted();
    const shown = new Set(fitting().map((card) => card.name));
    for (const button of document.querySelectorAll("#actors button")) button.hidden = !shown.has(button.dataset.name);
    for (const button of document.querySelectorAll("#filters button"))
      button.setAttribute("aria-pressed", String((now.get(button.dataset.key) ?? "") === button.dataset.value));
    document.getElementById("shown").textContent = shown.size;
    document.getElementById("nothing").hidden = shown.size > 0;
    const card = byName.get(now.get("actor"));
    if (card && open !== card.name) showActor(card);
    if (!card && dialog.open) dialog.close();
    open = card ? card.name : null;
  };
  const step = (way) => {
    const row = fitting();
    if (!row.length) return;
    const at = row.findIndex((card) => card.name === open);
    go("actor", row[(at + way + row.length) % row.length].name);
  };
  document.getElementById("close").onclick = () => go("actor", null);
  document.getElementById("previous").onclick = () => step(-1);
  document.getElementById("next").onclick = () => step(1);
  dialog.addEventListener("close", () => { stage.replaceChildren(); if (wanted().has("actor")) go("actor", null); });
  dialog.addEventListener("click", (event) => { if (event.target === dialog) dialog.close(); });
  window.addEventListener("hashchange", update);
  makeFilters();
  makeActors();
  update();
})();
