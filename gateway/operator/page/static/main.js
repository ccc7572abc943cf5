// The page: who is there, which part is open, and what every tick changes.
import { Alarms } from "./alarms.js";
import { Change } from "./change.js";
import { $, setText, show } from "./dom.js";
import { paintHealth } from "./health.js";
import { Refused, ask, keepToken, listen } from "./net.js";
import { Operate } from "./operate.js";
import { paintHistory } from "./past.js";
import { Picture } from "./picture.js";
import { notDone, reply, stopSent } from "./reply.js";
import { Trends } from "./trends.js";
import { number, preferred, speak, time, word } from "./words.js";

const STALE_MS = 1000, AGAIN_MS = 3000, SAFE_MS = 1500, RECORDS_MS = 3000, MOST_RECORDS = 200, LONG = 22, VIEWS = ["line", "change", "history", "health"];
let parts = null, tick = null, heard_ms = 0, broken = false, followed = null, stops = 0, skew_s = 0, list = null, records = [], again_at = 0, asked_ms = 0, asks = 0, newest = 0;

async function begin() {
  await speak(preferred());
  const unsaid = sessionStorage.getItem("unsaid");
  if (unsaid) notDone(unsaid);
  sessionStorage.removeItem("unsaid");
  try {
    const me = await ask("api/me");
    keepToken(me.token);
    idle(me.idle);
    await (me.role === null ? askName() : enter(me));
  } catch (error) {
    if (!(error instanceof Refused)) throw error;
    setText($("stale"), error.message);
    show($("stale"), true);
    setTimeout(begin, AGAIN_MS);
  }
}

// The session has ended, or its role is another one: everything anew. `unsaid`: what was pressed, and nobody heard.
function out(unsaid) {
  if (unsaid) sessionStorage.setItem("unsaid", unsaid);
  location.reload();
}

// A session in which nothing was said for long may still stop and hold; everything else wants a log-in.
function idle(name) {
  for (const id of ["stop", "hold", "idle"]) show($(id), Boolean(name));
  if (name) setText($("idle"), word("idle", { name }));
}

function askName() {
  for (const id of ["now", "views", "logout"]) show($(id), false);
  for (const view of VIEWS) show($(`view-${view}`), false);
  show($("stale"), false);
  show($("login"), true);
  $("login").elements.name.focus();
}

async function enter(me) {
  const line = await ask("api/line");
  show($("login"), false);
  show($("views"), true);
  show($("now"), true);
  const may = (command) => me.name !== null && line.may.includes(command);
  show($("stop"), Boolean(me.idle) || may("stop"));
  show($("logout"), true);
  setText($("logout"), word(me.name ? "logout" : "login.enter"));
  $("logout").onclick = me.name ? logOut : askName;
  setText($("me"), me.name ? `${me.name}, ${word(`role.${me.role}`)}` : word("role.anonymous"));
  $("view-line").classList.toggle("long", line.n > LONG);
  setText($("line-name"), `${line.site} / ${line.line}`);
  document.title = `${line.site} / ${line.line}`;
  route();
  parts = { line, picture: new Picture(line), trends: new Trends(line), alarms: new Alarms(say, may), change: new Change(say, may), operate: new Operate(line, say, may, () => list?.in_service) };
  heard_ms = performance.now();
  follow();
}

const follow = () => (followed ? followed() : (followed = listen(hear, () => setTimeout(again, AGAIN_MS))));

// The stream has been refused: there is no session any more, or too many look.
async function again() {
  try {
    (await ask("api/me")).role === null ? out() : follow();
  } catch (error) {
    if (!(error instanceof Refused)) throw error;
    setTimeout(again, AGAIN_MS);
  }
}

async function logOut() {
  try {
    await ask("api/logout", {});
    out();
  } catch (error) {
    if (!(error instanceof Refused)) throw error;
    reply(error);
  }
}

function hear(kind, data) {
  if (kind === "anew") return out();
  if (kind === "away") return;
  broken = true; // until all of it is on the screen
  take(data);
  [broken, heard_ms] = [false, performance.now()];
}

function take(data) {
  const first = !tick, before = tick;
  [tick, skew_s] = [data, data.wall_s - Date.now() / 1000];
  if (first) parts.trends.load(tick.wall_s);
  if (first || before.revision !== tick.revision) news();
  if (!first && before.loop.state !== tick.loop.state) setText($("announce"), word(`state.${tick.loop.state}`));
  paint();
}

function paint() {
  if (!tick || !parts) return;
  const { loop } = tick;
  setText($("now-state"), loop.running ? word(`state.${loop.state}`) : word("state.UNKNOWN"));
  setText($("now-speed"), number(tick.speed, 3));
  parts.alarms.paint(tick);
  parts.trends.paint(tick);
  if (open() === "line") {
    parts.picture.paint(tick);
    parts.operate.paint(tick);
  }
  if (open() === "health") paintHealth(tick, parts.line);
  setText($("audit-head"), tick.audit_head || "–");
  const { waiting } = tick;
  show($("waiting"), waiting.length > 0);
  setText($("waiting"), String(waiting.length));
  show($("prompt"), waiting.length > 0);
  setText($("prompt-text"), word(waiting.length === 1 ? "prompt.one" : "prompt.more", { count: waiting.length }));
  $("clock").dateTime = new Date(1000 * (tick.wall_s - (loop.age_s ?? 0))).toISOString(); // when the loop measured all this
}

// Four times a second, whether anything comes or not: how old it is, and how long there is to decide.
function look() {
  if (!parts) return;
  const old = performance.now() - heard_ms > STALE_MS, stale = old || broken || tick?.loop.running === false;
  show($("stale"), stale);
  document.body.classList.toggle("stale", stale);
  if (stale) setText($("stale"), word(broken ? "stale.broken" : !tick ? "stale.none" : old ? "stale.old" : "stale.loop"));
  setText($("clock"), tick ? (stale ? word("stale.at", { time: time(tick.wall_s) }) : time(tick.wall_s)) : "");
  parts.change.paint(Date.now() / 1000 + skew_s);
  if (open() === "history" && !document.hidden && performance.now() - asked_ms > RECORDS_MS) more();
}

// What has been recorded since, while somebody reads it.
async function more() {
  asked_ms = performance.now();
  try {
    const last = records.at(-1)?.sequence ?? 0, told = await ask(`api/records?after=${last}`);
    if (told.last < last) return news(); // the audit was begun anew
    if (last !== (records.at(-1)?.sequence ?? 0) || !told.records.length) return;
    records = [...records, ...told.records].slice(-MOST_RECORDS);
    parts.trends.told(records);
    if (open() === "history") paintHistory(list, records);
  } catch (error) {
    if (!(error instanceof Refused)) throw error; // it is asked again in a while
  }
}

// Proposals or records may be others now.
async function news() {
  clearTimeout(again_at);
  const mine = ++asks;
  try {
    const found = await ask("api/proposals"), told = await ask("api/records");
    if (mine < newest) return; // what was asked later has come already
    [newest, list, records] = [mine, found, told.records];
    parts?.trends.told(records);
  } catch (error) {
    if (!(error instanceof Refused)) throw error;
    if (error.status === 401) return out();
    again_at = setTimeout(news, AGAIN_MS);
  }
  route();
}

const open = () => {
  const name = location.hash.slice(1).split("/")[0];
  return VIEWS.includes(name) ? name : "line";
};

function route() {
  if (!$("login").hidden) return;
  const name = open();
  for (const view of VIEWS) {
    show($(`view-${view}`), view === name);
    const link = document.querySelector(`#views a[href="#${view}"]`);
    view === name ? link.setAttribute("aria-current", "page") : link.removeAttribute("aria-current");
  }
  if (!parts) return;
  if (name === "change") parts.change.open(location.hash.split("/")[1] ?? "", tick?.waiting ?? []);
  if (name === "history") paintHistory(list, records);
  paint();
}

async function say(said) {
  const stop = said.command === "stop", safe = stop || said.command === "hold", mine = stop ? ++stops : stops;
  const tell = (answer) => mine === stops && reply(answer, safe); // what comes late never covers what came of a stop
  if (stop) stopSent();
  try {
    // Stop and hold at an address of their own: there is a place for them where nothing else is answered any more.
    tell(await (safe ? ask(`api/${said.command}`, {}, SAFE_MS) : ask("api/say", said)));
  } catch (error) {
    if (!(error instanceof Refused)) throw error;
    if (error.status === 401) return out(stop ? "stop" : "said");
    tell(error);
  }
  if (parts) await news();
}

$("login").addEventListener("submit", async (event) => {
  event.preventDefault();
  const { name, password } = $("login").elements;
  setText($("login-refused"), "");
  try {
    await ask("api/login", { name: name.value, password: password.value });
    location.reload();
  } catch (error) {
    if (!(error instanceof Refused)) throw error;
    setText($("login-refused"), error.message);
  }
});
document.querySelector(".skip").addEventListener("click", (event) => {
  event.preventDefault(); // the part that is open stands behind the #
  $("content").focus();
});
for (const command of ["stop", "hold"]) $(command).addEventListener("click", () => say({ command }));
$("language").addEventListener("change", () => {
  localStorage.setItem("language", $("language").value);
  location.reload();
});
addEventListener("hashchange", () => {
  route();
  if (parts) news();
});
setInterval(look, 250);
begin();
