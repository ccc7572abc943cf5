// What an operator does: arm, start, hold, set-points, recipes, back to what is known to be good.
import { $, h, setText } from "./dom.js";
import { confirmed } from "./dialog.js";
import { number, word } from "./words.js";

const TWO_STEPS = ["arm", "start"];

export class Operate {
  constructor(line, say, may) {
    Object.assign(this, { line, say, may });
    this.fields = {};
    $("operate").replaceChildren(...(may("arm") ? this.forms() : [h("p", {}, word("operate.look-only"))]));
  }

  forms() {
    const button = (command) => h("button", { type: "button", onclick: () => this.command(command) }, word(`command.${command}`));
    return [h("p", { id: "operate-state" }), h("div", { class: "buttons" }, ["arm", "start", "hold"].map(button)),
      this.tension(), this.speed(), this.recipe(),
      h("div", { class: "buttons apart" }, h("button", { type: "button", onclick: () => this.back() }, word("operate.roll-back")))];
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

  tension() {
    const span = h("select", {}, this.line.spans.map((one, i) => h("option", { value: i + 1 }, `${i + 1} ${one.name}`)));
    const [min, max] = this.line.setpoint_n;
    const value = h("input", { type: "number", min, max, step: "0.1", required: true, inputmode: "decimal" });
    const put = () => this.last && (value.value = this.last.spans[span.value - 1][1]?.toFixed(1) ?? "");
    span.addEventListener("change", put);
    this.prefill = put;
    return this.form("tension", () => this.say({ command: "set", span: Number(span.value), tension_n: Number(value.value) }),
      h("label", {}, h("span", {}, word("operate.tension")), span),
      h("label", {}, h("span", {}, `N, ${number(min, 0)} ${word("operate.to")} ${number(max, 0)}`), value));
  }

  speed() {
    const max = this.line.speed_max_m_per_s;
    const value = this.fields.speed = h("input", { type: "number", min: 0, max, step: "0.001", required: true, inputmode: "decimal" });
    return this.form("speed", () => this.say({ command: "speed", speed_m_per_s: Number(value.value) }),
      h("label", {}, h("span", {}, `${word("operate.speed")}, m/s, 0 ${word("operate.to")} ${number(max, 2)}`), value));
  }

  recipe() {
    const name = h("select", {}, this.line.recipes.map((recipe) => h("option", { value: recipe.name },
      `${recipe.name} (${number(Math.min(...recipe.tension_n), 0)}–${number(Math.max(...recipe.tension_n), 0)} N, ${number(recipe.speed_m_per_s, 2)} m/s)`)));
    return this.form("recipe", () => this.say({ command: "recipe", name: name.value }), h("label", {}, h("span", {}, word("operate.recipe")), name));
  }

  async back() {
    const comment = await confirmed({ title: word("operate.sure-roll-back"), lines: [word("operate.then-roll-back")], yes: word("operate.roll-back"), comment: true });
    if (comment !== null) await this.say({ command: "roll-back", comment });
  }

  paint(tick) {
    const first = !this.last;
    this.last = tick;
    const state = $("operate-state");
    if (!state) return;
    setText(state, word(`next.${tick.loop.state}`));
    if (first) {
      this.prefill();
      this.fields.speed.value = tick.speed_setpoint ?? "";
    }
  }
}
