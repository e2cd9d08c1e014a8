// The page as a host of the front end: a model with anywidget's interface over fetch and server-sent events.
import front from "./front.js";

const state = { view: {}, whole_page: true };
const listeners = {};
const fire = (event, message) => (listeners[event] ?? []).forEach((callback) => callback(message));
const pause = (milliseconds) => new Promise((done) => setTimeout(done, milliseconds));
const GONE = "The program behind this page does not answer. If it has ended, start it again and open the address that it prints.";
const ELSEWHERE = "Your answer was not kept: this question was answered in another window or by another person, or was not yours any more after the connection was lost.";
const DONE = "All answers are given and kept. You can close this page.";
const SILENCE = 25; // seconds without a sign of life after which a connection is dead: page.py sends one every ten
const REPLY = 15, CLIP = 60; // seconds within which the server replies, on a slow line too
const PATIENCE = 20; // seconds without a server until the page says that it may have ended, and tries less often

const model = {
  get: (name) => state[name],
  on: (event, callback) => (listeners[event] ??= []).push(callback),
  off: (event, callback) => { listeners[event] = (listeners[event] ?? []).filter((known) => known !== callback); },
  send: (message) => post(message),
};

// Sent again until the server has heard it. The server takes each turn once, and knows by the key what is sent again,
// by this page or by the browser.
async function post(message) {
  const key = crypto.getRandomValues(new Uint32Array(4)).join("-");
  for (let again = false; ; again = true) {
    try {
      const reply = await fetch("answer", {
        method: "POST",
        headers: { "Content-Type": "application/json", "Idempotency-Key": key },
        body: JSON.stringify(message),
        signal: AbortSignal.timeout(1000 * REPLY),
      });
      if (again) back();
      if (reply.ok) return;
      fire("msg:custom", { refused: message.turn, say: reply.status === 409 ? ELSEWHERE : await reply.text() });
      return;
    } catch {
      if (over()) return;
      await missed();
    }
  }
}

let fetched = null; // the turn whose clips are here
let coming = null; // those that are on their way, and of which turn
let newest = 0;

async function clipsOf(turn) {
  return Promise.all([0, 1].map(async (side) => {
    const reply = await fetch(`clip/${turn}/${side}`, { signal: AbortSignal.timeout(1000 * CLIP) });
    if (!reply.ok) throw new Error(reply.statusText);
    return new Uint8Array(await reply.arrayBuffer());
  }));
}

async function take(view) {
  const mine = ++newest;
  if (view.phase === "question" && view.turn !== fetched) {
    // each answer of somebody else brings a view of the same turn: all of them wait for the same clips
    if (coming?.turn !== view.turn) coming = { turn: view.turn, clips: clipsOf(view.turn) };
    const awaited = coming;
    try {
      const sheets = await awaited.clips;
      if (mine !== newest) return;
      [state.first, state.second] = sheets;
      fetched = view.turn;
    } catch {
      if (coming === awaited) coming = null;
      if (mine !== newest) return;
      await pause(500); // the next view may be here by then
      if (mine === newest && !over()) await take(view);
      return;
    }
  }
  if (mine !== newest) return;
  state.view = view;
  fire("change:view");
}

let source, silence, lost = null;
const over = () => ["finished", "failed"].includes(state.view.phase);

function back() {
  lost = null;
  fire("msg:custom", { connection: "back" });
}

// Says that the server was not reached, and waits until it is time to try again.
async function missed() {
  lost ??= performance.now();
  const gone = performance.now() - lost > 1000 * PATIENCE;
  fire("msg:custom", gone ? { connection: "gone", say: state.view.all_given ? DONE : GONE } : { connection: "lost" });
  await pause(gone ? 3000 : 500);
}

function listen() {
  if (document.hidden) return;
  source = new EventSource("events");
  const heard = () => {
    clearTimeout(silence);
    silence = setTimeout(source.onerror, 1000 * SILENCE);
  };
  source.addEventListener("here", heard);
  source.onmessage = (event) => {
    heard();
    take(JSON.parse(event.data));
  };
  source.onopen = () => {
    heard();
    coming = null; // what a dead connection was to bring
    if (lost !== null) back();
  };
  source.onerror = async () => {
    clearTimeout(silence);
    source.close();
    if (over()) return;
    await missed();
    if (source.readyState === EventSource.CLOSED) listen(); // and has not since the window was seen again
  };
  heard();
}

// A browser has six connections to a server at most, and each window's events take one: those that nobody sees let go.
document.addEventListener("visibilitychange", () => {
  if (document.hidden) {
    clearTimeout(silence);
    source?.close();
  } else if (!over() && source?.readyState !== EventSource.OPEN) {
    source?.close();
    listen();
  }
});

front.render({ model, el: document.getElementById("front") });
listen();
