// The page of a run. It shows what the server sends, requests what is pressed, and nothing else.
//
// What always holds: what is shown as current has arrived within LOST; a press is about what was shown when it was made.
"use strict";

const LOST = 3000; // ms without a sign of life; the server gives one each second
const AGAIN = 4000; // ms between two attempts to connect
const OLD = 2500; // ms after which a picture is old
const NEXT_PICTURE = 350; // ms between two requests for a picture
const PRESS_AGAIN = 700; // ms: a press so soon after a change was meant for what was shown before
const WAIT = 8000; // ms for an answer: an episode that begins or ends answers when its file is there
const SURE = 4000; // ms within which the second press of a discard counts
const WORDS = { idle: "Idle", countdown: "Begins in", recording: "● REC", ending: "Ending…", reset: "Next in" };

const at = (id) => document.getElementById(id);
const now = () => Date.now(); // the clock that counts while a phone sleeps
const set = (element, text) => { if (element.textContent !== text) element.textContent = text; };

let view = null; // the newest view
let source = null; // the connection
let heard = -Infinity; // when something arrived that was current
let tried = -Infinity; // when the connection was last attempted
let skew = Infinity; // the smallest difference seen between this clock and the server's
let token = ""; // of the link, until the server has taken it
let denied = ""; // why the server shows nothing
let changed = -Infinity; // when the phase, or the episode that buttons are about, last changed
let asked = -Infinity; // when a discard was pressed for the first time
const pictures = new Map(); // by bit

// A clock that was set back proves nothing about what has arrived.
const isWithin = (ms, most) => ms >= 0 && ms <= most;
const isLost = () => !isWithin(now() - heard, LOST);

// --- the connection

async function enter() {
  if (location.hash.length > 1) {
    token = location.hash.slice(1);
    // Out of the address, which is copied and shown; a reload has the cookie.
    history.replaceState(null, "", location.pathname);
  }
  try {
    const answer = await fetch("/enter", { method: "POST", body: token, signal: AbortSignal.timeout(LOST) });
    denied = answer.ok ? "" : await answer.text();
    if (answer.ok) token = "";
  } catch { /* There is no network: it is tried again. */ }
}

async function connect() {
  const attempt = (tried = now());
  if (source) source.close();
  source = null;
  skew = Infinity;
  await enter();
  if (denied || attempt !== tried) return;
  source = new EventSource("/events");
  source.addEventListener("view", (event) => { hear(event); view = JSON.parse(event.data); render(); });
  source.addEventListener("beat", hear);
}

// After a pause a network delivers what was waiting in it: that is late, and not current.
function hear(event) {
  const difference = now() - Number(event.lastEventId);
  skew = Math.min(skew, difference);
  if (difference - skew < LOST) heard = now();
}

function watch() {
  if (isLost() && !isWithin(now() - tried, AGAIN)) connect();
  render();
}

// --- what is shown

function render() {
  const lost = isLost();
  document.body.classList.toggle("lost", lost);
  at("lost").hidden = !lost;
  const since = Number.isFinite(heard) ? `No connection since ${Math.max(0, Math.round((now() - heard) / 1000))} s` : "Connecting…";
  set(at("lost"), denied || since);
  if (view) show(view, lost);
  for (const [bit, picture] of pictures) age(bit, picture, lost);
  buttons(lost);
}

function show(view, lost) {
  set(at("rig"), view.rig + (view.is_simulated ? " (simulated)" : ""));
  document.title = (view.recording && !lost ? "● " : "") + view.rig;
  const { session, recording } = view;
  const counts = session ? ["GOOD", "SUSPECT", "BAD"].map((word, i) => session.verdicts[i] && `${session.verdicts[i]}\u00a0${word}`) : [];
  set(at("progress"), session ? [`${session.count} episodes`, ...counts.filter(Boolean)].join(" · ") : "");
  const waiting = view.begins_in === null ? "" : ` ${view.begins_in} s`;
  const running = recording && view.phase === "recording" ? ` ${recording.time}` : "";
  set(at("now"), lost ? "?" : WORDS[view.phase] + waiting + running);
  document.body.classList.toggle("recording", Boolean(recording) && !lost);
  const disk = view.disk_free && `disk: ${view.disk_free} free`;
  const figures = recording ? [view.current, recording.size, `dropped\u00a0${recording.dropped}`] : [session && session.task, disk];
  set(at("figures"), figures.filter(Boolean).join(" · "));
  const verdict = recording ? [`would be ${recording.verdict}`, ...recording.reasons] : [];
  list(at("reasons"), verdict, () => recording.verdict);
  const full = recording && recording.disk_full_in && `disk full in ${recording.disk_full_in}`;
  const failed = view.not_started && `not started: ${view.not_started}`;
  set(at("trouble"), [failed, full, ...view.stops, view.policy].filter(Boolean).join("\n"));
  showBits(view.bits, lost);
  showAbout(view.about);
  const line = (one) => `${new Date(one.ms).toLocaleTimeString()} ${one.text}`;
  list(at("warnings"), view.warnings.map(line), (i) => view.warnings[i].level);
}

function list(parent, texts, classOf) {
  while (parent.children.length > texts.length) parent.lastChild.remove();
  while (parent.children.length < texts.length) parent.append(document.createElement("li"));
  texts.forEach((text, i) => { set(parent.children[i], text); parent.children[i].className = classOf(i); });
}

function showBits(bits, lost) {
  const parent = at("bits");
  while (parent.children.length > bits.length) parent.lastChild.remove();
  while (parent.children.length < bits.length) {
    const cell = document.createElement("div");
    cell.append(document.createElement("b"), document.createElement("small"));
    parent.append(cell);
  }
  bits.forEach((bit, i) => {
    const [name, detail] = parent.children[i].children;
    // Of what is not current nothing is known.
    parent.children[i].className = lost ? "bit" : `bit ${bit.state} ${bit.is_set ? "set" : ""}`;
    set(name, `${lost ? "?" : bit.is_set ? "■" : "□"} ${bit.bit} ${bit.name}`);
    const rate = bit.state === "streaming" && bit.hz ? `${bit.hz} Hz` : bit.state === "absent" ? "" : bit.detail;
    set(detail, lost ? "unknown" : [bit.state, rate].filter(Boolean).join(": "));
    if (bit.is_camera && !pictures.has(bit.bit)) addPicture(bit);
    if (pictures.has(bit.bit)) pictures.get(bit.bit).of = bit;
  });
}

// The episode that labels and discards are about.
function showAbout(about) {
  at("about").hidden = !about;
  if (!about) return;
  set(at("about-verdict"), about.verdict || "");
  at("about-verdict").className = about.verdict || "";
  const length = typeof about.seconds === "number" ? `${about.seconds.toFixed(1)}\u00a0s` : "being recorded";
  set(at("about-file"), `${about.file}, ${length}`);
  list(at("about-reasons"), about.reasons || [], () => about.verdict || "");
  at("success").classList.toggle("chosen", about.label === "success");
  at("failure").classList.toggle("chosen", about.label === "failure");
}

// --- pictures

function addPicture(bit) {
  const figure = document.createElement("figure");
  const image = document.createElement("img");
  const caption = document.createElement("figcaption");
  figure.append(image, caption);
  at("pictures").append(figure);
  const picture = { of: bit, figure, image, caption, seq: "", captured: -Infinity };
  pictures.set(bit.bit, picture);
  fetchPictures(picture);
}

// One request at a time: a slow network gets fewer pictures, and no older ones.
async function fetchPictures(picture) {
  for (;;) {
    await new Promise((next) => setTimeout(next, NEXT_PICTURE));
    if (isLost() || document.hidden || !picture.of.is_set) continue;
    try {
      // Its age is as of the answer, which may have come slowly: counted from the request it is never too young.
      const sent = now();
      const answer = await fetch(`/picture/${picture.of.bit}?after=${picture.seq}`, { signal: AbortSignal.timeout(LOST) });
      if (answer.status !== 200) continue;
      const url = URL.createObjectURL(await answer.blob());
      URL.revokeObjectURL(picture.image.src);
      picture.image.src = url;
      picture.seq = answer.headers.get("x-seq");
      picture.captured = sent - Number(answer.headers.get("x-age-ms"));
    } catch { /* The next one is requested. */ }
  }
}

function age(bit, picture, lost) {
  const ms = now() - picture.captured;
  const isOld = lost || !isWithin(ms, OLD) || !picture.of.is_set;
  picture.figure.classList.toggle("old", isOld);
  const seen = Number.isFinite(ms) ? `${Math.round(ms / 1000)} s old` : "no picture";
  const why = picture.of.is_set || lost ? "" : ` (${picture.of.state})`;
  set(picture.caption, picture.of.name + (isOld ? `: ${seen}${why}` : ""));
}

// --- buttons

function buttons(lost) {
  const phase = view ? view.phase : "idle";
  const subject = view && view.about ? view.about.file : "";
  if (buttons.phase !== phase) { buttons.phase = phase; changed = now(); asked = -Infinity; }
  if (buttons.about !== subject) { buttons.about = subject; changed = now(); }
  const busy = lost || !view || isWithin(now() - changed, PRESS_AGAIN);
  const isRecording = phase === "recording";
  const waits = phase === "countdown" || phase === "reset";
  set(at("toggle"), isRecording ? "■ End" : waits ? "Start now" : "● Start");
  at("toggle").disabled = busy || phase === "ending";
  const isSure = isWithin(now() - asked, SURE) && subject === buttons.subject;
  set(at("discard"), isSure ? "Really discard" : view && view.current ? "Discard this" : "Discard last");
  at("discard").classList.toggle("sure", isSure);
  at("discard").disabled = busy || !subject;
  at("mark").hidden = !isRecording;
  at("mark").disabled = busy;
  at("undo").hidden = isRecording || !(view && view.session && view.session.discarded);
  at("undo").disabled = busy;
  for (const id of ["success", "failure"]) at(id).disabled = busy;
}

async function request(what) {
  try {
    const answer = await fetch("/do", { method: "POST", body: JSON.stringify(what), signal: AbortSignal.timeout(WAIT) });
    if (!answer.ok) return tell(await answer.text(), true);
    const { text, refused } = await answer.json();
    tell(text, refused);
  } catch {
    tell("no answer: look whether it was done before you press again", true);
  }
}

function tell(text, refused) {
  set(at("answer"), text);
  at("answer").className = refused ? "refused" : "";
}

at("toggle").addEventListener("click", () => {
  changed = now(); // What comes of it is shown before the next press counts.
  request({ do: view.phase === "recording" ? "stop" : "start" });
  render();
});
at("discard").addEventListener("click", () => {
  const subject = view.about.file;
  if (isWithin(now() - asked, SURE) && subject === buttons.subject) {
    asked = -Infinity;
    request({ do: "discard", episode: subject });
  } else {
    [asked, buttons.subject] = [now(), subject];
  }
  render();
});
for (const what of ["mark", "undo"]) {
  at(what).addEventListener("click", () => {
    changed = now(); // One press, one mark, and one episode back.
    request({ do: what });
    render();
  });
}
for (const label of ["success", "failure"]) {
  at(label).addEventListener("click", () => request({ do: "label", episode: view.about.file, label }));
}

setInterval(watch, 250);
document.addEventListener("visibilitychange", watch);
addEventListener("online", watch);
addEventListener("hashchange", connect);
connect();
