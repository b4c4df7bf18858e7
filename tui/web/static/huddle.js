/* The pages work without this script. It draws the curves so that they can be zoomed and read off,
   and keeps the page of the running test up to date. */
"use strict";

const byId = (id) => document.getElementById(id);

/* ------------------------------------------------------- colours and local time */

/* Without a choice the pages are as light or dark as the system; a choice is kept in this browser. */
function theme() {
  const root = document.documentElement, button = byId("theme"), KEY = "huddle-theme";
  const asked = () => matchMedia("(prefers-color-scheme: light)").matches ? "light" : "dark";
  const now = () => root.dataset.theme || asked();
  const name = () => { button.textContent = now() === "light" ? "Dark page" : "Light page"; };
  try { const kept = localStorage.getItem(KEY); if (kept) root.dataset.theme = kept; } catch { /* none is kept */ }
  if (!button) return;
  button.hidden = false;
  name();
  matchMedia("(prefers-color-scheme: light)").addEventListener("change", name);
  button.addEventListener("click", () => {
    root.dataset.theme = now() === "light" ? "dark" : "light";
    try { localStorage.setItem(KEY, root.dataset.theme); } catch { /* until the next page */ }
    name();
  });
}

/* Each instant is written in UTC; the time of this browser stands beside it where it differs. */
function localTimes(root) {
  for (const time of root.querySelectorAll("time[datetime]")) {
    const at = new Date(time.dateTime);
    if (time.querySelector("small") || !at.getTimezoneOffset()) continue;
    const sameDay = at.getDate() === at.getUTCDate();
    const day = sameDay ? {} : { month: "short", day: "numeric" };
    const seconds = time.dataset.precise === undefined ? {} : { second: "2-digit" };
    const text = at.toLocaleString("en-GB", { ...day, hour: "2-digit", minute: "2-digit", ...seconds, timeZoneName: "short" });
    time.append(Object.assign(document.createElement("small"), { textContent: ` (${text})` }));
  }
}

/* -------------------------------------------------------------------- curves */

function curves() {
  const box = byId("chart");
  if (!box || !window.uPlot) return () => {};
  const form = byId("choice"), plot = byId("plot"), reading = byId("reading"), whole = byId("whole");
  const RESTING = reading.textContent;
  let chart = null, span = null, isLoading = false, isOld = false;

  const query = () => {
    const found = new URLSearchParams(new FormData(form));
    if (!found.get("with")) found.delete("with");
    return found;
  };

  /* One request at a time: where answers are slow, newer requests must not starve all of them. */
  async function load() {
    if (isLoading) { isOld = true; return; }
    isLoading = true;
    do {
      isOld = false;
      const wanted = query();
      if (span) { wanted.set("from", span[0]); wanted.set("to", span[1]); }
      const answer = await fetch(`${box.dataset.source}?${wanted}`).catch(() => null);
      const found = answer && answer.ok ? await answer.json().catch(() => null) : null;
      if (found && found.curves.length) { choices(found); draw(found); }
    } while (isOld);
    isLoading = false;
  }

  /* A page that was opened before there were channels gets its choices now. */
  function choices(found) {
    if (form.elements.channel.options.length) return;
    for (const [name, words] of [["channel", found.channels], ["unit", found.units]])
      words.forEach((word, n) => form.elements[name].add(new Option(word, n)));
    form.hidden = false;
  }

  function draw(found) {
    const tables = [], series = [{}], bands = [], words = [];
    for (const curve of found.curves) {
      const columns = [curve.frequency, curve.level], at = series.length;
      const style = { stroke: curve.colour, width: 1.5, dash: curve.dash, points: { show: false } };
      series.push({ ...style, label: curve.label });
      if (curve.high.length) {
        columns.push(curve.high, curve.low);
        series.push({ ...style, width: 0 }, { ...style, width: 0 });
        bands.push({ series: [at + 1, at + 2], fill: curve.colour + "40" });
      }
      words.push({ at, label: curve.label, of: new Map(curve.frequency.map((f, n) => [f, curve.words[n]])) });
      tables.push(columns);
    }
    const data = tables.length > 1 ? uPlot.join(tables) : tables[0];
    const keep = chart;
    const axis = { stroke: "#a9b4c4", grid: { stroke: "#2b3442", width: 1 }, ticks: { stroke: "#2b3442", width: 1 } };
    const options = {
      width: plot.clientWidth, height: Math.max(300, Math.min(440, plot.clientWidth * 0.55)),
      scales: {
        x: { time: false, distr: 3, log: 10, range: () => found.span },
        y: { distr: found.is_logarithmic ? 3 : 1, log: 10, range: () => found.range },
      },
      axes: [
        { ...axis, label: "frequency (Hz)", filter: round, values: (_, ticks) => ticks.map((t) => (t === null ? "" : String(+t.toPrecision(6)))) },
        { ...axis, label: found.unit, size: 70, values: (_, ticks) => ticks.map((t) => (t === null ? "" : found.is_logarithmic ? t.toExponential(0) : String(t).replace("-", "−"))) },
      ],
      series, bands,
      legend: { show: false },
      cursor: { drag: { x: true, y: false, setScale: false } },
      hooks: {
        setCursor: [(u) => {
          const at = u.cursor.idx;
          if (at === null || at === undefined || u.cursor.left < 0) { reading.textContent = RESTING; return; }
          const frequency = u.data[0][at];
          const parts = words.map((each) => [each.label, nearest(each, u.data[0], at)]).filter((each) => each[1]);
          reading.textContent = `${+frequency.toPrecision(3)} Hz, ${found.unit}: ` +
            parts.map(([label, text]) => `${label} ${text}`).join(" · ");
        }],
        setSelect: [(u) => {
          if (u.select.width < 8) return;
          span = [u.posToVal(u.select.left, "x"), u.posToVal(u.select.left + u.select.width, "x")];
          whole.hidden = false;
          load();
        }],
      },
    };
    plot.querySelectorAll(":scope > svg").forEach((each) => each.remove());
    const key = plot.querySelector(".key") || plot.appendChild(Object.assign(document.createElement("ul"), { className: "key" }));
    key.replaceChildren(...found.curves.map(entry));
    chart = new uPlot(options, data, (u, init) => { plot.prepend(u.root); init(); });
    chart.root.setAttribute("role", "img");
    chart.root.setAttribute("aria-label", found.title);
    if (keep) keep.destroy();
    reading.hidden = false;
    box.dataset.drawn = found.curves.map((each) => each.label).join(" ");
    box.dataset.span = found.span.join(" ");
  }

  /* 1, 2 and 5 of each decade have a number; all, where less than a decade is seen. */
  function round(chart, ticks) {
    const { min, max } = chart.scales.x;
    return ticks.map((tick) => (max < 10 * min || "125".includes(tick.toExponential()[0]) ? tick : null));
  }

  /* Curves of two tests have frequencies of their own: the value nearest to the cursor is read. */
  function nearest(curve, frequencies, at) {
    for (let far = 0; far < 4; far++)
      for (const n of [at - far, at + far])
        if (curve.of.has(frequencies[n])) return curve.of.get(frequencies[n]);
    return "";
  }

  function entry(curve) {
    const item = document.createElement("li"), space = "http://www.w3.org/2000/svg";
    const mark = document.createElementNS(space, "svg"), line = document.createElementNS(space, "path");
    mark.setAttribute("viewBox", "0 0 20 6");
    mark.setAttribute("aria-hidden", "true");
    for (const [name, value] of [["d", "M0 3H20"], ["stroke", curve.colour], ["stroke-width", "3"], ["stroke-dasharray", curve.dash.join(" ")]]) line.setAttribute(name, value);
    mark.append(line);
    item.append(mark, ` ${curve.label}${curve.high.length ? ", with its 95 % interval" : ""}`);
    return item;
  }

  form.addEventListener("change", (event) => {
    if (event.target.name === "with") { form.submit(); return; }
    history.replaceState(null, "", `?${query()}`);
    load();
  });
  form.querySelector("button:not([type])").hidden = true;
  whole.addEventListener("click", () => { span = null; whole.hidden = true; load(); });
  let width = plot.clientWidth;
  new ResizeObserver(() => {
    if (chart && plot.clientWidth !== width) {
      width = plot.clientWidth;
      chart.setSize({ width, height: chart.height });
    }
  }).observe(plot);
  load();
  return load;
}

/* ------------------------------------------------- a recording against time */

function signal() {
  const box = byId("signal");
  if (!box) return;
  const form = byId("looking"), LEFT = Number(box.dataset.left), LEAST = 0.02;
  const whole = box.dataset.whole.split(" ").map(Number);
  let span = box.dataset.span.split(" ").map(Number), isLoading = false, isOld = false, drag = null;
  byId("how").hidden = false;

  function query() {
    const found = new URLSearchParams(new FormData(form));
    for (const name of ["at", "add"]) found.delete(name);
    return found;
  }

  async function load() {
    if (isLoading) { isOld = true; return; }
    isLoading = true;
    do {
      isOld = false;
      const asked = query();
      const answer = await fetch(`${box.dataset.source}?${asked}`).catch(() => null);
      if (!answer || !answer.ok) continue;
      box.innerHTML = await answer.text(); // escaped by the server
      box.dataset.span = span.join(" ");
      history.replaceState(null, "", `?${asked}`);
    } while (isOld);
    isLoading = false;
  }

  function show(begin, end) {
    const length = Math.min(end - begin, whole[1] - whole[0]);
    const first = Math.min(Math.max(begin, whole[0]), whole[1] - length);
    span = [first, first + length];
    [form.elements.from.value, form.elements.to.value] = span;
    load();
  }

  function zoom(factor, about = (span[0] + span[1]) / 2) {
    const used = Math.max(factor, LEAST / (span[1] - span[0]));
    show(about - used * (about - span[0]), about + used * (span[1] - about));
  }

  const share = (event) => {
    const { left, width } = box.querySelector("svg").getBoundingClientRect();
    return ((event.clientX - left) / width - LEFT) / (1 - LEFT);
  };
  /* What is chosen while the pointer is dragged. */
  function stretch() {
    const svg = box.querySelector("svg"), found = document.createElementNS("http://www.w3.org/2000/svg", "rect");
    for (const [name, value] of [["class", "excluded"], ["height", svg.viewBox.baseVal.height], ["width", 0]]) found.setAttribute(name, value);
    return svg.appendChild(found);
  }
  const inPicture = (event) => event.target.closest("svg") && share(event) >= 0;
  const pan = (by) => show(span[0] + by * (span[1] - span[0]), span[1] + by * (span[1] - span[0]));

  box.addEventListener("wheel", (event) => {
    if (!inPicture(event)) return;
    event.preventDefault();
    zoom(event.deltaY > 0 ? 2 : 0.5, span[0] + share(event) * (span[1] - span[0]));
  }, { passive: false });
  box.addEventListener("pointerdown", (event) => {
    if (!inPicture(event)) return;
    drag = { at: share(event), span, chosen: event.shiftKey ? stretch() : null };
    box.setPointerCapture(event.pointerId);
  });
  box.addEventListener("pointermove", (event) => {
    if (!drag) return;
    if (drag.chosen) {
      const { width } = box.querySelector("svg").viewBox.baseVal;
      drag.ends = [drag.at, Math.min(Math.max(share(event), 0), 1)].sort((a, b) => a - b);
      drag.chosen.setAttribute("x", width * (LEFT + (1 - LEFT) * drag.ends[0]));
      drag.chosen.setAttribute("width", width * (1 - LEFT) * (drag.ends[1] - drag.ends[0]));
      return;
    }
    const by = (drag.at - share(event)) * (drag.span[1] - drag.span[0]);
    show(drag.span[0] + by, drag.span[1] + by);
  });
  box.addEventListener("pointerup", () => {
    const ended = drag;
    drag = null;
    if (!ended || !ended.chosen) return;
    if (!ended.ends || ended.ends[0] === ended.ends[1]) { ended.chosen.remove(); return; }
    const at = (place) => new Date(1000 * (ended.span[0] + place * (ended.span[1] - ended.span[0]))).toISOString();
    form.elements.add.value = ended.ends.map(at).join("/");
    form.submit();
  });
  box.addEventListener("pointercancel", () => { drag = null; });
  box.addEventListener("keydown", (event) => {
    const act = { ArrowLeft: () => pan(-0.25), ArrowRight: () => pan(0.25), "+": () => zoom(0.5), "=": () => zoom(0.5), "-": () => zoom(2), Escape: () => show(...whole) }[event.key];
    if (act && !event.ctrlKey && !event.metaKey) { event.preventDefault(); act(); }
  });
  form.addEventListener("change", (event) => { if (!["at", "add"].includes(event.target.name)) load(); });
}

/* ------------------------------------------------------------- the running test */

function live(reload) {
  const box = byId("live");
  if (!box) return;
  const SILENT = 12000, AGAIN = 2000;
  let source = null, since = null, heard = Date.now(), tried = 0, version = Number(box.dataset.version);

  function lost() {
    if (since) return;
    since = new Date(heard);
    const clock = since.toLocaleTimeString("en-GB", { hour: "2-digit", minute: "2-digit" });
    byId("lost").textContent = `, connection lost since ${clock}`;
    box.classList.add("stale");
  }

  function back() {
    heard = Date.now();
    if (!since) return;
    since = null;
    byId("lost").textContent = "";
    box.classList.remove("stale");
  }

  function show(message) {
    back();
    const { parts, version: now } = JSON.parse(message.data);
    for (const [name, html] of Object.entries(parts)) {
      const place = byId(name);
      if (!place || place.contains(document.activeElement) && document.activeElement !== document.body) continue;
      place.innerHTML = html; // escaped by the server
      localTimes(place);
    }
    if (now !== version) { version = now; reload(); }
  }

  function connect() {
    if (source) source.close();
    tried = Date.now();
    source = new EventSource("/events");
    source.onmessage = show;
    source.addEventListener("tick", back);
    source.onerror = async () => {
      lost();
      if (source.readyState !== EventSource.CLOSED) return; // it tries again by itself
      const answer = await fetch("/now/curves", { method: "HEAD" }).catch(() => null);
      if (answer && answer.status === 401) { location.reload(); return; } // the visit has ended
      setTimeout(connect, AGAIN);
    };
  }

  /* Browsers open six connections to a server: tabs that nobody sees keep none. */
  document.addEventListener("visibilitychange", () => {
    if (document.hidden) source.close();
    else { heard = Date.now(); connect(); }
  });
  setInterval(() => { // a network that is gone closes nothing
    if (document.hidden || Date.now() - heard < SILENT) return;
    lost();
    if (Date.now() - tried > SILENT) connect();
  }, 1000);
  connect();
}

theme();
localTimes(document);
live(curves());
signal();
