'use strict'
// loadcell-amp, line-plc and r2r-drive-modbus of docs/devices on modbus-stream: node modbus_peer.js SPANS

const modbus = require('modbus-stream')
const { serve } = require('./control')
const { LineModel, Watchdog, RATED_TORQUE_NM, SERIALS } = require('./line_model')

const AMPLIFIER = 1, PLC = 2, FIRST_DRIVE = 11
const MOST_REGISTERS = 125
const line = new LineModel(Number(process.argv[2]))

const word = (value) => { const bytes = Buffer.alloc(2); bytes.writeUInt16BE(value & 0xFFFF); return bytes }
const high = (value) => word(value >> 16)
const int16 = (bytes) => bytes.readInt16BE(0)
const uint16 = (bytes) => bytes.readUInt16BE(0)
const int32 = (bytes) => Buffer.concat(bytes).readInt32BE(0)
const um = (metres) => Math.round(1e6 * metres)
const words32 = (value) => [high(value), word(value)]
const text = (value, count) => Array.from({ length: count }, (_, k) => Buffer.from(String(value).padEnd(2 * count, '\0').slice(2 * k, 2 * k + 2)))
const zeros = (count) => Array.from({ length: count }, () => word(0))
function float32 (value) {
  const bytes = Buffer.alloc(4)
  bytes.writeFloatBE(value)
  return [bytes.subarray(0, 2), bytes.subarray(2)]
}

const units = new Map([[AMPLIFIER, {
  functions: [3, 4],
  read: () => [
    word(0x5201), word(line.spans), word(1), word(line.measured.counter), ...text(SERIALS.amplifier, 8), ...zeros(4),
    ...Array.from(line.measured.tension).flatMap((tension, i) => {
      return line.broken.has(i) ? [...float32(NaN), word(2), word(0)] : [...float32(tension), word(0), word(0)]
    })
  ]
}], [PLC, {
  functions: [3, 6, 16, 23],
  writable: [10, 15],
  pairs: [11],
  read: () => {
    const { plc } = line
    const status = plc.permissive | plc.emergencyStopHealthy << 1 | plc.running << 2 | plc.tripped << 3
    return [
      word(0x5202), word(status), ...words32(um(plc.speed)), word(plc.life), ...words32(SERIALS.plc), ...zeros(3),
      word(plc.commanded), ...words32(um(plc.request)), word(plc.life), word(plc.watchdog.ms)
    ]
  },
  write: (registers, written) => {
    const { plc } = line
    if (uint16(registers[10]) > 1 || !Watchdog.allows(uint16(registers[14]))) return 'IllegalDataValue'
    if (written(14)) plc.watchdog.set(uint16(registers[14]))
    plc.command(uint16(registers[10]) === 1, 1e-6 * int32(registers.slice(11, 13)), uint16(registers[13]))
  }
}]])
line.axes.forEach((axis, i) => units.set(FIRST_DRIVE + i, {
  functions: [3, 6, 16, 23],
  writable: [10, 12],
  extra: 23,
  pairs: [10],
  read: () => [
    word(0x5203), word(axis.statusword), ...words32(um(axis.speed)), word(Math.round(1000 * axis.torqueNm / RATED_TORQUE_NM)),
    word(0), word(axis.error), ...zeros(3), word(axis.controlword), word(Math.round(1000 * axis.torqueNm / RATED_TORQUE_NM)),
    ...words32(SERIALS.drive + i), ...zeros(6), ...words32(1000 * RATED_TORQUE_NM), word(1000), word(axis.watchdog.ms)
  ],
  write: (registers, written) => {
    if (!Watchdog.allows(uint16(registers[23]))) return 'IllegalDataValue'
    if (written(23)) axis.watchdog.set(uint16(registers[23]))
    if (!written(10)) return
    axis.watchdog.feed()
    axis.command(uint16(registers[10]), int16(registers[11]) / 1000 * RATED_TORQUE_NM)
  }
}))

// An exception code in the words of modbus-stream.
class Refusal extends Error {}

const faults = new Map() // unit: 'exception' or 'freeze'

function read (unit, address, quantity) {
  if (quantity < 1 || quantity > MOST_REGISTERS) throw new Refusal('IllegalDataValue')
  const registers = unit.read()
  if (address + quantity > registers.length) throw new Refusal('IllegalDataAddress')
  return registers.slice(address, address + quantity)
}

function write (unit, address, values) {
  const end = address + values.length
  const written = (register) => address <= register && register < end
  const [first, last] = unit.writable
  const inside = (register) => (first <= register && register < last) || register === unit.extra
  if (!values.every((_, k) => inside(address + k))) throw new Refusal('IllegalDataAddress')
  if (unit.pairs.some((register) => written(register) !== written(register + 1))) throw new Refusal('IllegalDataValue')
  const registers = unit.read()
  registers.splice(address, values.length, ...values)
  const refused = unit.write(registers, written)
  if (refused) throw new Refusal(refused)
}

// One request: `act` reads or writes and returns what modbus-stream builds the answer from.
function answer (code, act) {
  return (request, reply) => {
    const unit = units.get(request.unitId)
    const fault = faults.get(request.unitId)
    if (fault === 'freeze') return
    if (fault === 'exception') return reply('ServerDeviceFailure')
    if (!unit) return reply('GatewayTargetDeviceFailedToRespond')
    if (!unit.functions.includes(code)) return reply('IllegalFunction')
    line.advance()
    try {
      reply(null, ...act(unit, request.request))
    } catch (error) {
      if (!(error instanceof Refusal)) throw error
      reply(error.message)
    }
  }
}

const sockets = new Set()
const server = modbus.tcp.server({ debug: null }, (connection) => {
  connection.on('error', (error) => process.stderr.write(`${error.stack}\n`)) // a connection that is lost, too
  connection.on('read-holding-registers', answer(3, (unit, { address, quantity }) => [read(unit, address, quantity)]))
  connection.on('read-input-registers', answer(4, (unit, { address, quantity }) => [read(unit, address, quantity)]))
  connection.on('write-single-register', answer(6, (unit, { address, value }) => {
    write(unit, address, [value])
    return [address, value]
  }))
  connection.on('write-multiple-registers', answer(16, (unit, { address, values }) => {
    write(unit, address, values)
    return [address, values.length]
  }))
  connection.on('read-write-multiple-registers', answer(23, (unit, data) => {
    write(unit, data.write_address, data.values)
    return [read(unit, data.read_address, data.read_quantity)]
  }))
})
server.on('connection', (socket) => {
  sockets.add(socket)
  socket.setNoDelay(true)
  socket.on('close', () => sockets.delete(socket))
})

let port = 0
const listen = () => new Promise((resolve) => server.listen(port, '127.0.0.1', () => { port = server.address().port; resolve() }))

listen().then(() => serve({ port }, {
  state: () => line.state(),
  fault: (unit, kind) => { line.tell(`fault ${kind}`); faults.set(unit, kind) },
  heal: () => { faults.clear(); line.frozen = false; line.broken.clear(); line.plc.permissive = true },
  freeze_measurement: () => { line.tell('fault'); line.frozen = true },
  break_wire: (channel) => { line.tell('fault'); line.broken.add(channel - 1) },
  take_permissive: () => { line.tell('fault'); line.plc.permissive = false },
  close: () => new Promise((resolve) => {
    line.tell('fault')
    server.close(() => resolve())
    sockets.forEach((socket) => socket.destroy())
  }),
  open: listen
}))
