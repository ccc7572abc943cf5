'use strict'
// A small line behind the devices of docs/devices: web, axes, load cells, line control. It knows no protocol.
// Axes, channels and spans count from 0 here.

const { performance } = require('node:perf_hooks')

const STEP_S = 0.001
const MOST_STEPS = 2000 // after a pause of the process
const STIFFNESS_N = 2200, LENGTH_M = 1.2, RADIUS_M = 0.035, INERTIA_KG_M2 = 1.0, FRICTION_NMS = 15.0
const NOISE_N = 0.1
const RATED_TORQUE_NM = 60.0
// Of the first drive (the next ones follow), the amplifier and the line PLC: those that the wiring is proved with.
const SERIALS = { drive: 0x52530001, amplifier: 0x52540000, plc: 0x52550000 }
const STATUSWORD = { DISABLED: 0x0250, READY: 0x0231, SWITCHED_ON: 0x0233, ENABLED: 0x1237, QUICK_STOP: 0x0217, FAULT: 0x0218 }
const WATCHDOG_ERROR = 0x8250

// A life sign that must not stay away longer than `ms` once it has come; 0 is off.
class Watchdog {
  constructor () { this.set(0) }
  set (ms) { this.ms = ms; this.fedMs = null }
  feed () { if (this.ms) this.fedMs = performance.now() }
  end () { this.fedMs = null }
  get late () { return this.fedMs !== null && performance.now() - this.fedMs > this.ms }
  static allows (ms) { return ms === 0 || (ms >= 10 && ms <= 1000) }
}

// The state machine of CiA 402 as docs/devices/r2r-drive-modbus.md has it: one step for each command.
class Axis {
  constructor (tell) {
    this.tell = tell
    this.state = 'DISABLED'
    this.controlword = 0
    this.torqueNm = 0
    this.speed = 0
    this.error = 0
    this.watchdog = new Watchdog()
  }

  get statusword () { return STATUSWORD[this.state] }

  command (controlword, torqueNm) {
    const before = this.controlword
    this.controlword = controlword
    const next = this.state === 'FAULT' ? this.reset(before) : this.next(controlword & 0x0F)
    if (next !== this.state) this.become(next)
    if (this.state === 'ENABLED') this.torqueNm = Math.max(-RATED_TORQUE_NM, Math.min(RATED_TORQUE_NM, torqueNm))
  }

  reset (before) { return (this.controlword & ~before & 0x80) ? 'DISABLED' : 'FAULT' }

  next (word) {
    if (!(word & 0x02) || this.state === 'QUICK_STOP') return (word & 0x02) ? 'QUICK_STOP' : 'DISABLED'
    if (!(word & 0x04)) return this.state === 'ENABLED' ? 'QUICK_STOP' : 'DISABLED'
    if ((word & 0x07) === 0x06) return 'READY'
    if (this.state === 'DISABLED') return 'DISABLED'
    return word === 0x0F ? 'ENABLED' : 'SWITCHED_ON'
  }

  become (state) {
    this.state = state
    if (state !== 'ENABLED' && state !== 'QUICK_STOP') this.torqueNm = 0
    if (state === 'DISABLED') { this.error = 0; this.watchdog.end() }
    this.tell(state)
  }

  step () {
    if (this.watchdog.late) { this.watchdog.end(); this.error = WATCHDOG_ERROR; this.become('FAULT') }
    if (this.state !== 'QUICK_STOP') return
    const ramp = RATED_TORQUE_NM / 0.1 * STEP_S
    this.torqueNm = Math.sign(this.torqueNm) * Math.max(0, Math.abs(this.torqueNm) - ramp)
    if (this.torqueNm === 0) this.become('DISABLED')
  }
}

// docs/devices/line-plc.md; its ramp is "step".
class LinePlc {
  constructor (tell) {
    this.tell = tell
    this.permissive = true
    this.emergencyStopHealthy = true
    this.life = 0
    this.request = 0
    this.commanded = false
    this.blocked = false // until run has been 0
    this.tripped = false
    this.watchdog = new Watchdog()
  }

  get running () { return this.commanded && !this.blocked }
  get speed () { return this.running ? this.request : 0 }

  command (run, speed, life) {
    if (run !== this.commanded) this.tell(run ? 'run' : 'run off')
    if (!run) { this.blocked = false; this.tripped = false }
    if (life !== this.life) this.watchdog.feed()
    Object.assign(this, { commanded: run, request: speed, life })
    this.step()
  }

  step () {
    if (!this.permissive || !this.emergencyStopHealthy) this.blocked = true
    if (!this.commanded || !this.watchdog.late) return
    this.watchdog.end()
    this.blocked = this.tripped = true
    this.tell('watchdog')
  }
}

class LineModel {
  constructor (spans) {
    this.spans = spans
    this.events = []
    this.tension = new Float64Array(spans)
    this.axes = Array.from({ length: spans }, (_, i) => new Axis((what) => this.tell(`axis ${i + 1} ${what}`)))
    this.plc = new LinePlc((what) => this.tell(`plc ${what}`))
    this.frozen = false // the amplifier measures no more
    this.broken = new Set() // channels with a wire break
    this.measured = { counter: 0, tension: new Float64Array(spans) }
    this.atMs = performance.now()
    this.seed = 1
    setInterval(() => this.advance(), 2)
  }

  tell (what) { this.events.push([performance.now(), what]) }

  // Bring the line to this instant, and measure.
  advance () {
    const steps = Math.floor((performance.now() - this.atMs) / (1000 * STEP_S))
    this.atMs += steps * 1000 * STEP_S
    for (let k = Math.max(0, steps - MOST_STEPS); k < steps; k++) this.step()
    if (steps > 0 && !this.frozen) {
      this.measured.counter = (this.measured.counter + steps) & 0xFFFF
      this.tension.forEach((value, i) => { this.measured.tension[i] = value + NOISE_N * this.noise() })
    }
  }

  // The two equations of docs/simulated-line.md, speeds first.
  step () {
    this.plc.step()
    const { tension, axes } = this
    axes.forEach((axis, i) => {
      axis.step()
      const ahead = i + 1 < this.spans ? tension[i + 1] : 0
      const pull = RADIUS_M ** 2 * (ahead - tension[i]) - FRICTION_NMS * axis.speed + RADIUS_M * axis.torqueNm
      axis.speed += STEP_S * pull / INERTIA_KG_M2
    })
    axes.forEach((axis, i) => {
      const [before, into] = i ? [axes[i - 1].speed, tension[i - 1] * axes[i - 1].speed] : [this.plc.speed, 0]
      tension[i] += STEP_S / LENGTH_M * (STIFFNESS_N * (axis.speed - before) + into - tension[i] * axis.speed)
    })
  }

  // Uniform in [-1, 1], the same in every run (Numerical Recipes' linear congruential generator).
  noise () {
    this.seed = (Math.imul(this.seed, 1664525) + 1013904223) >>> 0
    return this.seed / 2 ** 31 - 1
  }

  // For the test, which sees from inside what the gateway cannot.
  state () {
    return {
      now_ms: performance.now(),
      tension_n: [...this.tension],
      torque_nm: this.axes.map((axis) => axis.torqueNm),
      axes: this.axes.map((axis) => axis.state),
      axis_watchdogs_ms: this.axes.map((axis) => axis.watchdog.ms),
      plc_watchdog_ms: this.plc.watchdog.ms,
      speed_m_per_s: this.plc.speed,
      life: this.plc.life,
      events: this.events
    }
  }
}

module.exports = { LineModel, Watchdog, RATED_TORQUE_NM, SERIALS }
