// The front end of the page and of the notebook's widget: two clips in step, a question, keys and buttons.
//
// `model` is anywidget's: get(name), send(message), on(event, callback), off(event, callback).
//   view           what to show: {phase, turn, task, answered, budget, iteration, clips, rate, worth, sure, advice, undo, say,
//                  answerer, practice: [number, of], notice, most (bits an answer may be worth), all_given}
//   first, second  the sprite sheets of the two clips, bytes
//   whole_page     whether keys count wherever the focus is
// It sends {turn, answer, seconds, replays} and hears, as "msg:custom", {refused: turn, say} and {connection: "lost" | "back"}.
// A turn is answered at most once: after an answer everything is locked until the next turn or a refusal.

const KEYS = {
  ArrowLeft: "first", ArrowRight: "second", ArrowDown: "tie", t: "tie", T: "tie", s: "skip", S: "skip", u: "undo", U: "undo",
  Enter: "begin",
};
const SAID = {
  first: "First is better", second: "Second is better", tie: "No difference", skip: "Skipped", undo: "Taken back", begin: "Practice",
};
const LOST = "The connection is lost. Trying again…";
const MOST_REPLAYS = 10000; // that are sent
const HASTE = 300; // milliseconds after which a question takes an answer: a double click is one answer
const REST = 0.8; // seconds on the last picture before the clips start again

const HTML = `
<div class="bp-box" tabindex="0" role="region" aria-label="Compare two clips" data-lm-suppress-shortcuts="true">
  <header>
    <span class="bp-task"></span>
    <span class="bp-count"></span>
    <progress class="bp-progress" max="1" value="0" aria-label="Answers given"></progress>
  </header>
  <h2 class="bp-ask">Which one is better?</h2>
  <div class="bp-intro">
    <p>Two clips play side by side. Choose the better one. You decide what is better, unless you were given a rule.</p>
    <ul>
      <li><b>First is better</b> <kbd>←</kbd> or <b>Second is better</b> <kbd>→</kbd></li>
      <li><b>No difference</b> <kbd>↓</kbd> if both are equally good</li>
      <li><b>Cannot tell</b> <kbd>S</kbd> if you are unsure, which is fine</li>
      <li><b>Undo</b> <kbd>U</kbd> takes your last answer back</li>
      <li><b>Pause</b> <kbd>Space</kbd> stops both clips, and starts them again</li>
    </ul>
    <p>Take your time. Each answer is kept at once, and you can stop and go on later.</p>
    <p class="bp-who"></p>
    <p>You practise first. Practice answers are not kept.</p>
    <button type="button" class="bp-choice" data-answer="begin"><span>Start the practice</span><kbd>Enter</kbd></button>
  </div>
  <div class="bp-clips">
    <figure>
      <canvas role="img" width="320" height="320"></canvas>
      <figcaption></figcaption>
      <button type="button" class="bp-choice" data-answer="first"><kbd>←</kbd><span>First is better</span></button>
    </figure>
    <figure>
      <canvas role="img" width="320" height="320"></canvas>
      <figcaption></figcaption>
      <button type="button" class="bp-choice" data-answer="second"><span>Second is better</span><kbd>→</kbd></button>
    </figure>
  </div>
  <div class="bp-film" role="group" aria-label="Playback">
    <button type="button" class="bp-play" aria-label="Pause" title="Pause or play (space)"></button>
    <button type="button" class="bp-again" aria-label="From the start" title="From the start"></button>
    <input class="bp-scrub" type="range" min="0" max="1000" value="0" step="1" aria-label="Time">
    <span class="bp-step"></span>
    <label class="bp-speed">Speed <select aria-label="Speed">
      <option value="0.5">0.5 ×</option><option value="1" selected>1 ×</option>
      <option value="2">2 ×</option><option value="4">4 ×</option></select></label>
  </div>
  <div class="bp-rest">
    <button type="button" data-answer="tie"><span>No difference</span><kbd>↓</kbd></button>
    <button type="button" data-answer="skip"><span>Cannot tell</span><kbd>S</kbd></button>
    <button type="button" data-answer="undo"><span>Undo</span><kbd>U</kbd></button>
  </div>
  <p class="bp-learner"></p>
  <p class="bp-note" role="alert" hidden></p>
  <p class="bp-live" role="status" aria-live="polite"></p>
</div>`;

const bytes = (value) => (value instanceof DataView ? new Uint8Array(value.buffer, value.byteOffset, value.byteLength) : value);

// One clock for both clips, in steps of the environment: they cannot drift apart.
class Film {
  constructor(box) {
    this.box = box;
    this.canvases = [...box.querySelectorAll("canvas")];
    this.scrub = box.querySelector(".bp-scrub");
    this.step = box.querySelector(".bp-step");
    this.button = box.querySelector(".bp-play");
    this.speed = 1;
    this.clips = [];
    this.at = 0;
    this.play(!matchMedia("(prefers-reduced-motion: reduce)").matches);
  }

  load(clips, sheets, rate) {
    for (const sheet of this.sheets ?? []) sheet.close();
    Object.assign(this, { clips, sheets, rate, at: 0, replays: 0, longest: Math.max(...clips.map((clip) => clip.steps)) });
    this.canvases.forEach((canvas, k) => {
      canvas.width = clips[k].width;
      canvas.height = clips[k].height;
      canvas.dataset.frame = "";
    });
    if (this.resumes) this.play(true);
    this.draw();
  }

  play(playing) {
    this.playing = playing;
    this.resumes = false;
    this.button.dataset.playing = playing;
    this.button.setAttribute("aria-label", playing ? "Pause" : "Play");
  }

  move(at) {
    this.at = Math.max(0, Math.min(at, this.longest));
    this.draw();
  }

  // A person moves the clips by hand, until the next question.
  seek(at) {
    const resumes = this.playing || this.resumes;
    this.play(false);
    this.resumes = resumes;
    if (this.clips.length) this.move(at * this.longest);
  }

  again() {
    this.replays = Math.min(this.replays + 1, MOST_REPLAYS);
    this.move(0);
  }

  tick(now) {
    const seconds = Math.min(0.25, (now - (this.last ?? now)) / 1000);
    this.last = now;
    if (!this.playing || !this.clips.length) return;
    this.at += seconds * this.rate * this.speed;
    if (this.at > this.longest + REST * this.rate * this.speed) this.again();
    else this.draw();
  }

  draw() {
    const at = Math.min(this.at, this.longest);
    this.canvases.forEach((canvas, k) => {
      const { frames, columns, width, height, steps } = this.clips[k];
      const frame = Math.round((Math.min(at, steps) / steps) * (frames - 1));
      if (canvas.dataset.frame === String(frame)) return;
      const pen = canvas.getContext("2d");
      pen.clearRect(0, 0, width, height);
      const [x, y] = [(frame % columns) * width, Math.floor(frame / columns) * height];
      pen.drawImage(this.sheets[k], x, y, width, height, 0, 0, width, height);
      canvas.dataset.frame = frame;
      canvas.dataset.step = (frame / Math.max(1, frames - 1)) * steps;
    });
    const text = `step ${Math.round(at)} of ${this.longest}`;
    if (this.step.textContent === text) return;
    this.step.textContent = text;
    this.scrub.value = Math.round((1000 * at) / this.longest);
    this.scrub.setAttribute("aria-valuetext", text);
  }
}

function caption(clip, name) {
  return `${name}: ${clip.steps} steps${clip.ended ? ", then it ended" : ""}`;
}

// What the learner says about the question, without a hint at either side.
function learnerText({ worth, sure, advice, notice, most }) {
  const parts = [];
  if (sure !== null && sure !== undefined) parts.push(`The learner is ${Math.round(100 * sure)} % sure what you will say.`);
  if (worth !== null && worth !== undefined) parts.push(`Your answer is worth about ${worth.toFixed(2)} bit, of ${most ? most.toFixed(1) : 1} at most.`);
  if (advice) parts.push(advice);
  return [parts.join(" "), notice].filter(Boolean).join("\n");
}

function render({ model, el }) {
  const root = document.createElement("div");
  root.className = model.get("whole_page") ? "bayespbrl bp-page" : "bayespbrl";
  root.innerHTML = HTML;
  el.append(root);
  const find = (name) => root.querySelector(name);
  const [box, ask, note, live] = [".bp-box", ".bp-ask", ".bp-note", ".bp-live"].map(find);
  const film = new Film(box);
  let view = {}, alive = true, locked = true, answered = null, shown = 0, loads = 0, loaded = null, gone = false, slow, soon;

  function lock(yes) {
    locked = yes;
    box.dataset.locked = yes;
    for (const button of root.querySelectorAll("[data-answer]")) {
      const off = yes || (button.dataset.answer === "undo" && !view.undo);
      button.setAttribute("aria-disabled", off);
    }
  }

  function say(text, aloud = text) {
    if (ask.textContent !== text) ask.textContent = text;
    if (live.textContent !== aloud) live.textContent = aloud;
  }

  function warn(text) {
    note.textContent = text ?? "";
    note.hidden = !text;
  }

  function progress() {
    const { answered: done = 0, budget, task = "", answerer } = view;
    find(".bp-task").textContent = answerer ? `${task}, answered by ${answerer}` : task;
    find(".bp-count").textContent = budget ? `${done} of at most ${budget} answers` : `${done} answers`;
    const bar = find(".bp-progress");
    bar.hidden = !budget;
    bar.value = budget ? done / budget : 0;
  }

  async function take() {
    clearTimeout(soon);
    view = model.get("view") ?? {};
    box.dataset.phase = view.phase ?? "thinking";
    progress();
    if (view.turn !== answered) clearTimeout(slow);
    if (view.phase === "instructions") return instruct();
    if (view.phase !== "question") {
      lock(true);
      const thinking = view.phase === "thinking" || !view.phase;
      find(".bp-learner").textContent = thinking && view.iteration ? `${view.iteration} iterations of the policy are done.` : "";
      say(view.say || "Thinking…");
      return;
    }
    if (loaded !== view.turn) {
      const load = ++loads, turn = view.turn;
      lock(true); // the clips of another question are still on the screen
      const sheets = await Promise.all(["first", "second"].map((name) => createImageBitmap(new Blob([bytes(model.get(name))]))));
      if (load !== loads || !alive || view.turn !== turn || view.phase !== "question") return; // another view came meanwhile
      film.load(view.clips, sheets, view.rate);
      loaded = view.turn;
      shown = performance.now();
    }
    film.canvases.forEach((canvas, k) => {
      const text = caption(view.clips[k], ["First", "Second"][k]);
      canvas.setAttribute("aria-label", text);
      canvas.nextElementSibling.textContent = text;
    });
    find(".bp-learner").textContent = learnerText(view);
    if (view.turn === answered) return; // the answer is on its way
    const known = box.dataset.turn === String(view.turn); // others have answered, or this turn's answer was refused
    const early = HASTE - (performance.now() - shown);
    lock(early > 0);
    if (early > 0) soon = setTimeout(() => lock(false), early);
    box.dataset.turn = view.turn;
    const which = view.practice ? `Practice ${view.practice.join(" of ")}: which one is better?` : "Which one is better?";
    const number = view.practice ? "" : `Question ${view.answered + 1}. `;
    say(which, known ? live.textContent : `${number}${which} ${view.notice} Left arrow: first. Right arrow: second. ${view.advice ?? ""}`);
    if (!known) focus();
  }

  function instruct() {
    const kept = view.answerer ? `under the name ${view.answerer}` : "without a name";
    find(".bp-who").textContent = `Your answers are kept ${kept}. All windows of this page show the same question and count as one person.`;
    find(".bp-learner").textContent = "";
    if (view.turn !== answered) lock(false);
    say("Before you start", "Before you start: read what is asked, then press Enter.");
    if (box.dataset.turn !== String(view.turn)) focus(); // a view of the same turn leaves it on the button
    box.dataset.turn = view.turn;
  }

  function focus() {
    if (root.contains(document.activeElement) || model.get("whole_page")) box.focus({ preventScroll: true });
  }

  function answer(which) {
    if (locked || (which === "undo" && !view.undo) || (which === "begin") !== (view.phase === "instructions")) return;
    lock(true);
    answered = view.turn;
    warn(null);
    live.textContent = SAID[which];
    slow = setTimeout(() => { box.dataset.phase = "thinking"; say("Thinking…"); }, 150);
    const seconds = (performance.now() - shown) / 1000;
    model.send({ turn: view.turn, answer: which, seconds, replays: film.replays ?? 0 });
  }

  function hear(message) {
    if (message.connection === "lost" && note.hidden) warn(LOST);
    if (message.connection === "gone") {
      gone = true;
      clearTimeout(soon);
      lock(true);
      warn(message.say);
    }
    if (message.connection === "back" && (gone || note.textContent === LOST)) {
      warn(null);
      if (gone) take();
      gone = false;
    }
    if (message.refused === undefined) return;
    if (message.refused !== answered) return warn(message.say); // of an earlier turn, sent again
    answered = null;
    clearTimeout(slow);
    take().finally(() => warn(message.say));
  }

  function key(event) {
    const { target } = event;
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const still = target.matches?.("input") ? " tTsSuU" : "tTsSuU"; // the space bar opens a menu, and moves no slider
    const moves = target.matches?.("input, select") && !still.includes(event.key);
    const presses = target.matches?.("button") && [" ", "Enter"].includes(event.key);
    if (moves || presses) return event.stopPropagation();
    if (event.key !== " " && !(event.key in KEYS)) return;
    if (event.key !== "Enter" && view.phase === "instructions") return; // it scrolls
    event.preventDefault();
    event.stopPropagation();
    if (event.repeat) return;
    if (event.key === " ") film.play(!film.playing);
    else answer(KEYS[event.key]);
  }

  const keys = model.get("whole_page") ? window : box;
  keys.addEventListener("keydown", key);
  root.addEventListener("click", ({ target, detail }) => {
    const button = target.closest("[data-answer]");
    if (button && detail < 2) answer(button.dataset.answer);
    if (detail && target.closest("button")) box.focus({ preventScroll: true }); // the space bar pauses, and presses no button
  });
  film.button.addEventListener("click", () => film.play(!film.playing));
  find(".bp-again").addEventListener("click", () => film.clips.length && film.again());
  let pointed = false; // whether the speed is chosen by a pointer, not by keys
  const speed = find(".bp-speed select");
  speed.addEventListener("pointerdown", () => { pointed = true; });
  speed.addEventListener("keydown", () => { pointed = false; });
  speed.addEventListener("change", () => {
    film.speed = Number(speed.value);
    if (pointed) box.focus({ preventScroll: true });
  });
  film.scrub.addEventListener("input", () => film.seek(film.scrub.value / 1000));
  film.scrub.addEventListener("pointerup", () => box.focus({ preventScroll: true })); // its keys answer again

  (function paint(now) {
    if (!alive) return;
    requestAnimationFrame(paint);
    film.tick(now);
  })(performance.now());
  model.on("change:view", take);
  model.on("msg:custom", hear);
  lock(true);
  take();
  return () => {
    alive = false;
    clearTimeout(slow);
    clearTimeout(soon);
    keys.removeEventListener("keydown", key);
    model.off("change:view", take);
    model.off("msg:custom", hear);
  };
}

export default { render };
