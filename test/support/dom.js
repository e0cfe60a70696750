// What the scripts of the pages need of a browser, without a window: elements, a clock that the
// tests move, and a record of what is drawn, asked and sent. See tabs.py, which answers `callPython`.
"use strict";

(function () {
  const timers = [], media = new Map();
  const browser = {
    now: 0,  // [ms]
    ink: "rgb(17, 34, 51)",  // the text colour of every element
    latency: 0,  // [ms] of every answer
    agrees: true,  // to the questions of `confirm`
    doings: [],  // questions and requests that change something, in order
    requested: [],  // paths of the other requests, in order
    errors: [],  // of scripts that run on after they were started
  };

  // --- elements

  const number = (text, otherwise) => {
    const found = text === null || text === "" ? NaN : Number(text);
    return Number.isFinite(found) ? found : otherwise;
  };

  class Style {
    setProperty(name, value) { this[name] = value; }
  }

  class Element {
    constructor(tag, attributes = {}) {
      this.tagName = tag.toUpperCase();
      this.nodes = [];  // elements and strings
      this.parent = null;
      this.listeners = {};
      this.style = new Style();
      this.dataset = {};
      this.id = attributes.id ?? "";
      this.className = attributes.class ?? "";
      this.hidden = "hidden" in attributes;
      this.type = attributes.type ?? "";
      this.name = attributes.name ?? "";
      this.selected = "selected" in attributes;
      this.clientWidth = 900;  // [px]
      this.texts = [];  // all that were set, in order
      this.pictures = [];  // all that were drawn in it, in order
      this.ends = {min: null, max: null, step: null};
      this.given = attributes.value;
      for (const [name, value] of Object.entries(attributes)) {
        if (name.startsWith("data-")) { this.dataset[name.slice(5)] = value; }
      }
    }

    get children() { return this.nodes.filter((node) => node instanceof Element); }

    get textContent() {
      return this.nodes.map((node) => (node instanceof Element ? node.textContent : node)).join("");
    }

    set textContent(text) {
      this.texts.push(String(text));
      this.replaceChildren(String(text));
    }

    set innerHTML(markup) { this.markup = markup; }

    get innerHTML() { throw new Error("markup is not read back"); }

    append(...nodes) {
      for (const node of nodes) {
        const kept = node instanceof Element ? node : String(node);
        if (kept instanceof Element) { kept.parent = this; }
        this.nodes.push(kept);
        // oxlint-disable-next-line no-eval -- as a browser does with a script that joins the page
        if (kept.tagName === "SCRIPT" && attached(kept)) { (0, eval)(kept.textContent); }
      }
    }

    replaceChildren(...nodes) {
      this.nodes = [];
      this.place = undefined;
      this.append(...nodes);
    }

    addEventListener(name, listener) { (this.listeners[name] ??= []).push(listener); }

    // Options of a select, and what is chosen.
    get options() { return this.children.filter((child) => child.tagName === "OPTION"); }

    get selectedIndex() {
      const first = Math.max(this.options.findIndex((option) => option.selected), 0);
      return this.options.length ? this.place ?? first : -1;
    }

    get value() {
      if (this.tagName === "SELECT") { return this.options[this.selectedIndex]?.value ?? ""; }
      if (this.tagName === "OPTION") { return this.given ?? this.textContent; }
      if (this.tagName === "INPUT") { return this.type === "range" ? String(this.inRange()) : this.given ?? ""; }
      return this.given;
    }

    set value(value) {
      if (this.tagName === "SELECT") {
        this.place = this.options.findIndex((option) => option.value === String(value));
      } else {
        this.given = value === null ? "" : String(value);
        if (this.type === "range") { this.given = this.inRange(); }
      }
    }

    // A slider keeps its value between its ends, and on whole steps from the lower one.
    inRange() {
      const min = number(this.min, 0), max = Math.max(number(this.max, 100), min);
      const value = Math.min(Math.max(number(this.given ?? null, (min + max) / 2), min), max);
      return this.step === "any" ? value : min + Math.round(value - min);
    }

    setEnd(name, value) {
      this.ends[name] = String(value);
      if (this.type === "range" && this.given !== undefined) { this.given = this.inRange(); }
    }

    get min() { return this.ends.min; }

    set min(value) { this.setEnd("min", value); }

    get max() { return this.ends.max; }

    set max(value) { this.setEnd("max", value); }

    get step() { return this.ends.step; }

    set step(value) { this.setEnd("step", value); }
  }

  const root = new Element("html"), documentListeners = {};

  function attached(element) {
    return element === root || (element.parent !== null && attached(element.parent));
  }

  function* below(element) {
    for (const child of element.children) {
      yield child;
      yield* below(child);
    }
  }

  function matches(element, selector) {
    const parts = /^(\w*)(?:#([\w-]+))?(?:\.([\w-]+))?(?:\[data-([\w-]+)(?:="(.*)")?\])?$/.exec(selector);
    if (!parts) { throw new Error(`no selector that this browser knows: ${selector}`); }
    const [, tag, id, className, data, value] = parts;
    return (!tag || element.tagName === tag.toUpperCase()) && (!id || element.id === id)
      && (!className || element.className.split(" ").includes(className))
      && (!data || (data in element.dataset && (value === undefined || element.dataset[data] === value)));
  }

  const document = {
    title: "",
    hidden: false,
    documentElement: root,
    get head() { return document.querySelectorAll("head")[0]; },
    createElement: (tag) => new Element(tag),
    getElementById: (id) => [...below(root)].find((element) => element.id === id) ?? null,
    querySelectorAll: (selector) => [...below(root)].filter((element) => matches(element, selector)),
    addEventListener: (name, listener, capture) => {
      (documentListeners[name] ??= []).push({listener, capture});
    },
  };

  class Option extends Element {
    constructor(text = "", value = undefined) {
      super("option");
      this.textContent = text;
      if (value !== undefined) { this.given = String(value); }
    }
  }

  // --- what tests do in the page

  // The page as the parser found it: [tag, attributes, nodes] within each other, and strings.
  browser.build = (nodes) => {
    const made = (node) => {
      if (typeof node === "string") { return node; }
      const [tag, attributes, inside] = node, element = new Element(tag, attributes);
      element.nodes = inside.map(made);
      for (const child of element.children) { child.parent = element; }
      return element;
    };
    root.nodes = made(["html", {}, nodes]).nodes;
    for (const child of root.children) { child.parent = root; }
    document.title = document.querySelectorAll("title")[0]?.textContent ?? "";
  };

  browser.find = (selector) => {
    const [found] = document.querySelectorAll(selector);
    if (!found) { throw new Error(`the page has no ${selector}`); }
    return found;
  };

  // Whether the page prevents what the browser would do itself.
  browser.dispatch = (target, name, details = {}) => {
    const event = {type: name, target, ...details, prevented: false, preventDefault() { this.prevented = true; }};
    for (const listener of target.listeners?.[name] ?? []) { listener.call(target, event); }
    target[`on${name}`]?.(event);
    for (const {listener, capture} of documentListeners[name] ?? []) {
      if (capture || name !== "toggle") { listener.call(document, event); }  // toggles do not bubble
    }
    return event.prevented;
  };

  browser.setMedia = (query, applies) => {
    const list = matchMedia(query);
    list.matches = applies;
    for (const listener of list.listeners) { listener({matches: applies}); }
  };

  // Run the next timer that is due until a time [ms]; whether there was one.
  browser.step = (until) => {
    timers.sort((one, other) => one.due - other.due);
    if (!timers.length || timers[0].due > until) {
      browser.now = until;
      return false;
    }
    const {due, work} = timers.shift();
    browser.now = due;
    work();
    return true;
  };

  browser.watch = (result) => {
    if (result instanceof Promise) {
      result.catch((error) => browser.errors.push(`${error}\n${error.stack}`));
    }
  };

  // --- what scripts see

  const QUERIES = ["(prefers-color-scheme: dark)", "(max-width: 700px)"];

  function matchMedia(query) {
    if (!QUERIES.includes(query)) { throw new Error(`no media query that this browser knows: ${query}`); }
    if (!media.has(query)) {
      const listeners = [];
      media.set(query, {matches: false, listeners,
        addEventListener: (name, listener) => { if (name === "change") { listeners.push(listener); } }});
    }
    return media.get(query);
  }

  let lastTimer = 0;

  function setTimeout(work, wait = 0) {
    lastTimer += 1;
    timers.push({name: lastTimer, due: browser.now + wait, work});
    return lastTimer;
  }

  function clearTimeout(name) {
    const place = timers.findIndex((timer) => timer.name === name);
    if (place >= 0) { timers.splice(place, 1); }
  }

  async function fetch(path, {method = "GET", headers = {}, body = ""} = {}) {
    if (method === "GET") {
      browser.requested.push(path);
    } else {
      browser.doings.push([method, path, headers["Content-Type"] ?? "", JSON.parse(body)]);
    }
    const {status, text, lost} = JSON.parse(callPython("answer", JSON.stringify([method, path, body])));
    browser.now += browser.latency;
    if (lost) { throw new TypeError("Failed to fetch"); }
    return {ok: status >= 200 && status < 300, status, text: async () => text, json: async () => JSON.parse(text)};
  }

  class Blob {
    constructor(parts) { this.bytes = parts.flatMap((part) => [...part]); }

    stream() {
      const {bytes} = this;
      return {bytes, pipeThrough: ({format}) => ({bytes, format})};
    }
  }

  class DecompressionStream {
    constructor(format) { this.format = format; }
  }

  class Response {
    constructor({bytes, format}) { Object.assign(this, {bytes, format}); }

    async text() { return JSON.parse(callPython("unpack", JSON.stringify([this.bytes, this.format]))); }
  }

  // The viewer that pages load or unpack: it keeps a copy of what it is given.
  const draw = (how) => (box, traces, layout, config) => {
    if (!(box instanceof Element)) { throw new Error("the picture has no box"); }
    box.pictures.push(JSON.stringify({how, traces, layout, config}));
    box.on = (name, listener) => box.addEventListener(name, listener);
  };
  browser.Plotly = {react: draw("react"), newPlot: draw("newPlot")};

  Object.assign(globalThis, {
    window: globalThis,
    browser, document, Option, matchMedia, setTimeout, clearTimeout, fetch, Blob, DecompressionStream, Response,
    performance: {now: () => browser.now},
    getComputedStyle: (element) => ({color: element instanceof Element ? browser.ink : undefined}),
    confirm: (question) => {
      browser.doings.push(["confirm", question]);
      return browser.agrees;
    },
  });
})();
