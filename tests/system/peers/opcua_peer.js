'use strict'
// docs/devices/r2r-opcua.md on node-opcua: node opcua_peer.js SPANS FOLDER (for the certificates it makes)

const path = require('node:path')
const { serve } = require('./control')
const { OPCUACertificateManager } = require('node-opcua-certificate-manager')
const { MessageSecurityMode, SecurityPolicy } = require('node-opcua-secure-channel')
const { DataValue } = require('node-opcua-data-value')
const { OPCUAServer } = require('node-opcua-server')
const { StatusCodes } = require('node-opcua-status-code')
const { DataType, Variant } = require('node-opcua-variant')
const { LineModel, Watchdog, RATED_TORQUE_NM, SERIALS } = require('./line_model')

const line = new LineModel(Number(process.argv[2]))
const { plc } = line

// All values of one Read belong to one instant: node-opcua reads them all before it does anything else.
let instant = null
function now () {
  if (instant === null) {
    line.advance()
    instant = new Date()
    setImmediate(() => { instant = null })
  }
  return instant
}

let frozen = false // the server answers, but nothing of what it says or does is new
let refused = false // writes are refused

// node-opcua hands over the values of one Write one by one. What they do is done together, when all are there.
const waiting = new Map() // device: what was written to it
function write (device, key, value, act) {
  if (!waiting.size) setImmediate(commit)
  if (!waiting.has(device)) waiting.set(device, { act, values: {} })
  waiting.get(device).values[key] = value
}
function commit () {
  line.advance()
  for (const { act, values } of waiting.values()) act(values)
  waiting.clear()
}

const read = (dataType, value, status = () => StatusCodes.Good) => ({
  dataType,
  timestamped_get: () => {
    const sourceTimestamp = now()
    return new DataValue({ sourceTimestamp, statusCode: status(), value: new Variant({ dataType, value: value() }) })
  }
})
const written = (dataType, device, key, act, value, allowed = () => true) => ({
  ...read(dataType, value),
  timestamped_set: async ({ value: variant }) => {
    if (refused) return StatusCodes.BadUserAccessDenied
    if (variant.dataType !== dataType) return StatusCodes.BadTypeMismatch
    if (!allowed(variant.value)) return StatusCodes.BadOutOfRange
    if (!frozen) write(device, key, variant.value, act)
    return StatusCodes.Good
  }
})
const { Boolean: BOOLEAN, UInt16: UINT16, UInt32: UINT32, Double: DOUBLE, String: STRING } = DataType

function axisNodes (axis, i) {
  let life = 0
  let torqueNm = 0
  const act = (values) => {
    if ('watchdog' in values) axis.watchdog.set(values.watchdog)
    if ('torque' in values) torqueNm = values.torque
    if ('life' in values && values.life !== life) { life = values.life; axis.watchdog.feed() }
    if ('controlword' in values || 'torque' in values) axis.command(values.controlword ?? axis.controlword, torqueNm)
  }
  return {
    DeviceId: read(UINT32, () => 0x5205),
    SerialNumber: read(STRING, () => String(SERIALS.drive + i)),
    Statusword: read(UINT16, () => axis.statusword),
    Speed: read(DOUBLE, () => axis.speed),
    Torque: read(DOUBLE, () => axis.torqueNm),
    SafeTorqueOff: read(BOOLEAN, () => false),
    ErrorCode: read(UINT16, () => axis.error),
    Controlword: written(UINT16, axis, 'controlword', act, () => axis.controlword),
    TargetTorque: written(DOUBLE, axis, 'torque', act, () => torqueNm, Number.isFinite),
    Life: written(UINT16, axis, 'life', act, () => life),
    Watchdog: written(UINT16, axis, 'watchdog', act, () => axis.watchdog.ms, Watchdog.allows),
    RatedTorque: read(DOUBLE, () => RATED_TORQUE_NM),
    MaxTorque: read(DOUBLE, () => RATED_TORQUE_NM)
  }
}

function lineNodes () {
  let warning = false
  const act = (values) => {
    if ('watchdog' in values) plc.watchdog.set(values.watchdog)
    if ('warning' in values) warning = values.warning
    plc.command(values.run ?? plc.commanded, values.speed ?? plc.request, values.life ?? plc.life)
  }
  return {
    DeviceId: read(UINT32, () => 0x5207),
    SerialNumber: read(UINT32, () => SERIALS.plc),
    Permissive: read(BOOLEAN, () => plc.permissive),
    EmergencyStopHealthy: read(BOOLEAN, () => plc.emergencyStopHealthy),
    Running: read(BOOLEAN, () => plc.running),
    WatchdogTripped: read(BOOLEAN, () => plc.tripped),
    Local: read(BOOLEAN, () => false),
    UnwindSpeed: read(DOUBLE, () => plc.speed),
    LifeEcho: read(UINT16, () => plc.life),
    Run: written(BOOLEAN, plc, 'run', act, () => plc.commanded),
    Warning: written(BOOLEAN, plc, 'warning', act, () => warning),
    SpeedRequest: written(DOUBLE, plc, 'speed', act, () => plc.request, Number.isFinite),
    Life: written(UINT16, plc, 'life', act, () => plc.life),
    Watchdog: written(UINT16, plc, 'watchdog', act, () => plc.watchdog.ms, Watchdog.allows)
  }
}

const amplifierNodes = () => ({
  DeviceId: read(UINT32, () => 0x5206),
  SerialNumber: read(STRING, () => String(SERIALS.amplifier)),
  Channels: read(UINT16, () => line.spans),
  SampleCounter: read(UINT16, () => line.measured.counter),
  Healthy: read(BOOLEAN, () => true)
})

const cellNodes = (i) => ({
  Tension: read(DOUBLE, () => line.broken.has(i) ? NaN : line.measured.tension[i],
    () => line.broken.has(i) ? StatusCodes.BadSensorFailure : StatusCodes.Good),
  Status: read(UINT16, () => line.broken.has(i) ? 2 : 0)
})

function build (addressSpace) {
  const namespace = addressSpace.registerNamespace('urn:r2rgate:devices')
  const add = (name, nodes) => {
    const object = namespace.addObject({ organizedBy: addressSpace.rootFolder.objects, browseName: name, nodeId: `s=${name}` })
    for (const [browseName, { dataType, ...value }] of Object.entries(nodes)) {
      const access = value.timestamped_set ? 'CurrentRead | CurrentWrite' : 'CurrentRead'
      namespace.addVariable({
        componentOf: object, browseName, nodeId: `s=${name}.${browseName}`, dataType, value,
        minimumSamplingInterval: 10, accessLevel: access, userAccessLevel: access
      })
    }
  }
  line.axes.forEach((axis, i) => add(`Axis${i + 1}`, axisNodes(axis, i)))
  add('Amplifier', amplifierNodes())
  line.axes.forEach((_, i) => add(`Cell${i + 1}`, cellNodes(i)))
  add('Line', lineNodes())
}

let port = 0
let server
async function open () {
  const folder = path.resolve(process.argv[3])
  const certificates = new OPCUACertificateManager({ automaticallyAcceptUnknownCertificate: true, rootFolder: folder })
  await certificates.initialize()
  server = new OPCUAServer({
    port,
    host: '127.0.0.1',
    hostname: '127.0.0.1',
    securityPolicies: [SecurityPolicy.None],
    securityModes: [MessageSecurityMode.None],
    allowAnonymous: true,
    disableDiscovery: true,
    serverCertificateManager: certificates,
    userCertificateManager: certificates,
    buildInfo: { productName: 'r2r-opcua' }
  })
  await server.initialize()
  build(server.engine.addressSpace)
  await server.start()
  port = server.endpoints[0].port
}

open().then(() => serve({ port }, {
  state: () => line.state(),
  freeze: () => { line.tell('fault'); frozen = line.frozen = true },
  refuse: () => { line.tell('fault'); refused = true },
  break_wire: (channel) => { line.tell('fault'); line.broken.add(channel - 1) },
  take_permissive: () => { line.tell('fault'); plc.permissive = false },
  heal: () => { frozen = line.frozen = refused = false; line.broken.clear(); plc.permissive = true },
  close: async () => { line.tell('fault'); await server.shutdown(0) },
  open
}))
