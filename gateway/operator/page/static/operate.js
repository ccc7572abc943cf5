// What an operator does: arm, start, hold, set-points, recipes, back to what is known to be good.
import { $, h, setText, show } from "./dom.js";
import { confirmed } from "./dialog.js";
import { number, word } from "./words.js";

const TWO_STEPS = ["arm", "start"], BASELINE = "phi_stable";

export class Operate {
  // `runs`: the hash of what is in service.
  constructor(line, say, may, runs) {
    Object.assign(this, { line, say, may, runs });
    this.follows = []; // what puts the line's set-points into fields that nobody has touched
    $("operate").replaceChildren(...(may("arm") ? this.forms() : [h("p", {}, word("operate.look-only"))]));
  }

  forms() {
    const button = (command) => h("button", { type: "button", onclick: () => this.command(command) }, word(`command.${command}`));
    return [h("p", { id: "operate-state" }), h("div", { class: "buttons" }, ["arm", "start", "hold"].map(button)),
      this.tension(), this.speed(), this.recipe(),
      h("div", { class: "buttons apart" },
        h("button", { type: "button", onclick: () => this.back() }, word("operate.roll-back")),
        this.may("confirm") && h("button", { type: "button", id: "confirm", hidden: true, onclick: () => this.confirm() }, word("operate.confirm")),
        h("button", { type: "button", id: "abort", hidden: true, onclick: () => this.say({ command: "experiment-abort" }) }, word("operate.abort"))),
      this.may("archive") && h("div", { class: "buttons" },
        h("button", { type: "button", onclick: () => this.archive() }, word("operate.archive")),
        h("button", { type: "button", onclick: () => this.lineChanged() }, word("operate.line-changed")))].filter(Boolean);
  }

  async archive() {
    const configuration = this.runs();
    if (!configuration) return;
    const lines = [word("operate.then-archive"), word("history.in-service", { hash: configuration.slice(0, 12) })];
    const because = await confirmed({ title: word("operate.sure-archive"), lines, yes: word("operate.yes-archive"), comment: true, needed: true });
    if (because) await this.say({ command: "archive", configuration, name: BASELINE, because });
  }

  // A first configuration: whoever says it answers for it, and what has not been seen of it yet is told.
  async confirm() {
    const configuration = this.runs();
    if (!configuration) return;
    const lines = [word("operate.then-confirm"), word("history.in-service", { hash: configuration.slice(0, 12) })];
    const because = await confirmed({ title: word("operate.sure-confirm"), lines, yes: word("operate.yes-confirm"), comment: true, needed: true });
    if (because) await this.say({ command: "confirm", configuration, because });
  }

  async lineChanged() {
    const because = await confirmed({ title: word("operate.sure-line-changed"), lines: [word("operate.then-line-changed")], yes: word("operate.yes-line-changed"), comment: true, needed: true });
    if (because) await this.say({ command: "line-changed", because });
  }

  async command(command) {
    if (TWO_STEPS.includes(command)) {
      const answer = await confirmed({ title: word(`operate.sure-${command}`), lines: [word(`operate.then-${command}`)], yes: word(`command.${command}`) });
      if (answer === null) return;
    }
    await this.say({ command });
  }

  form(name, submit, ...fields) {
    return h("form", { class: "set", onsubmit: (event) => { event.preventDefault(); submit(); } },
      ...fields, h("button", { "aria-label": `${word("operate.set")}: ${word(`operate.${name}`)}` }, word("operate.set")));
  }

  // A field for a number, with the line's own in it until somebody writes another.
  field(min, max, now) {
    const input = h("input", { type: "number", min, max, step: "any", required: true, inputmode: "decimal" });
    let touched = false, writings = 0;
    const put = () => {
      const text = String((this.last && now()) ?? "");
      if (!touched && input.value !== text) input.value = text;
    };
    input.addEventListener("input", () => {
      touched = input.value !== "";
      writings += 1;
    });
    const anew = () => {
      touched = false;
      writings += 1;
      put();
    };
    input.addEventListener("blur", () => touched || put());
    this.follows.push(() => document.activeElement !== input && put());
    // What is written, or chosen, while the answer is on its way stays.
    const sending = () => {
      const sent = writings;
      return () => writings === sent && anew();
    };
    return { input, anew, sending };
  }

  tension() {
    const span = h("select", {}, this.line.spans.map((one, i) => h("option", { value: i + 1 }, `${i + 1} ${one.name}`)));
    const band = () => this.line.setpoint_n[span.value - 1], [min, max] = band();
    const value = this.field(min, max, () => this.last.spans[span.value - 1][1]), allowed = h("span");
    const bound = () => {
      const [least, most] = band();
      Object.assign(value.input, { min: least, max: most });
      setText(allowed, `N, ${number(least, 0)} ${word("operate.to")} ${number(most, 0)}`);
    };
    bound();
    span.addEventListener("change", bound);
    span.addEventListener("change", value.anew);
    const submit = async () => {
      const answered = value.sending();
      await this.say({ command: "set", span: Number(span.value), tension_n: Number(value.input.value) });
      answered();
    };
    return this.form("tension", submit,
      h("label", {}, h("span", {}, word("operate.tension")), span),
      h("label", {}, allowed, value.input));
  }

  speed() {
    const max = this.line.speed_max_m_per_s;
    const value = this.field(0, max, () => this.last.speed_setpoint);
    const submit = async () => {
      const to = Number(value.input.value), answered = value.sending(), from = this.last?.speed_setpoint ?? 0;
      const lines = [changed(word("operate.speed"), from, to, "m/s", 3)];
      if (to > from && (await confirmed({ title: word("operate.sure-speed"), lines, yes: word("operate.set") })) === null) return;
      await this.say({ command: "speed", speed_m_per_s: to });
      answered();
    };
    return this.form("speed", submit,
      h("label", {}, h("span", {}, `${word("operate.speed")}, m/s, 0 ${word("operate.to")} ${number(max, 2)}`), value.input));
  }

  recipe() {
    const options = this.line.recipes.map((recipe) => h("option", { value: recipe.name },
      `${recipe.name} (${number(Math.min(...recipe.tension_n), 0)}–${number(Math.max(...recipe.tension_n), 0)} N, ${number(recipe.speed_m_per_s, 2)} m/s)`));
    const name = h("select", { required: true }, h("option", { value: "" }, word("operate.choose")), options);
    const submit = async () => {
      const recipe = this.line.recipes.find((one) => one.name === name.value), lines = this.byRecipe(recipe);
      if ((await confirmed({ title: word("operate.sure-recipe", { name: recipe.name }), lines, yes: word("operate.set"), wide: true })) === null) return;
      await this.say({ command: "recipe", name: recipe.name });
      name.value = "";
    };
    return this.form("recipe", submit, h("label", {}, h("span", {}, word("operate.recipe")), name));
  }

  // Every set-point that it would move.
  byRecipe(recipe) {
    const from = this.last, lines = [];
    if (from?.speed_setpoint == null || Math.abs(from.speed_setpoint - recipe.speed_m_per_s) > 1e-4) lines.push(changed(word("operate.speed"), from?.speed_setpoint, recipe.speed_m_per_s, "m/s", 3));
    recipe.tension_n.forEach((to, i) => {
      const was = from?.spans[i]?.[1];
      if (was == null || Math.abs(was - to) > 0.005) lines.push(changed(`${word("operate.tension")} ${i + 1}`, was, to, "N", 1));
    });
    return lines.length ? lines : [word("operate.same")];
  }

  async back() {
    const comment = await confirmed({ title: word("operate.sure-roll-back"), lines: [word("operate.then-roll-back")], yes: word("operate.roll-back"), comment: true });
    if (comment !== null) await this.say({ command: "roll-back", comment });
  }

  paint(tick) {
    this.last = tick;
    const state = $("operate-state");
    if (!state) return;
    setText(state, word(`next.${tick.loop.state}`));
    if ($("confirm")) show($("confirm"), tick.unconfirmed);
    show($("abort"), tick.change?.kind === "experiment" && tick.change.stage === "running");
    for (const follow of this.follows) follow();
  }
}

function changed(what, from, to, unit, digits) {
  return word("operate.from-to", { what, from: `${number(from, digits)} ${unit}`, to: `${number(to, digits)} ${unit}` });
}
