'use strict'
// A panel, as docs/operator.md describes it, on node-opcua: node operator_client.js ENDPOINT PKI FOLDER
// PKI is the folder of `r2rgate pki init`; FOLDER is for what the client keeps of its own.

const fs = require('node:fs')
const path = require('node:path')
const { serve } = require('./control')
const { OPCUACertificateManager } = require('node-opcua-certificate-manager')
const {
  AttributeIds, BrowseDirection, constructEventFilter, DataType, EndpointDescription, MessageSecurityMode, OPCUAClient,
  ofType, TimestampsToReturn, UserTokenPolicy, UserTokenType
} = require('node-opcua-client')

const [endpoint, pki, folder] = process.argv.slice(2)
const NAMESPACE = 'urn:r2rgate:line'
const POLICIES = 'http://opcfoundation.org/UA/SecurityPolicy#'
const BASIC = `${POLICIES}Basic256Sha256`
const SERVER = 'i=2253'
const EVENT_FIELDS = ['EventType', 'Message', 'Severity', 'SourceName', 'Time']
const OWN_FIELDS = ['ProposalId', 'ShownHash', 'BaseRevision', 'Sequence', 'Kind', 'Who']
const CONDITION_FIELDS = [
  'EventType', 'ConditionName', 'Retain', 'DialogState.Id', 'Prompt', 'ResponseOptionSet', 'LastResponse'
]
const CLASSES = { 1: 'Object', 2: 'Variable', 4: 'Method' }

let certificates
let serverCertificate // that the client trusts, as a file that somebody has carried to it
const sessions = new Map() // by the name that the test gives: { client, session, ns, seen, events }

// What a session's nodes are called.
const nodeId = (held, name) => `ns=${held.ns};s=${name}`

const plain = (value) => {
  if (value === null || value === undefined) return null
  if (value instanceof Date) return value.toISOString()
  if (ArrayBuffer.isView(value)) return Array.from(value)
  if (Array.isArray(value)) return value.map(plain)
  if (value.text !== undefined && value.locale !== undefined) return value.text
  return value
}

const told = (dataValue) => ({
  value: plain(dataValue.value?.value),
  type: DataType[dataValue.value?.dataType ?? DataType.Null],
  status: dataValue.statusCode.name,
  at: plain(dataValue.sourceTimestamp)
})

// A client that asks the server for what it is not offered: node-opcua would not even try.
function insist (client, securityMode, securityPolicyUri) {
  const find = client.findEndpointForSecurity.bind(client, MessageSecurityMode.SignAndEncrypt, BASIC)
  client.findEndpoint = () => {
    const offered = find()
    const nobody = new UserTokenPolicy({ policyId: 'anonymous', tokenType: UserTokenType.Anonymous })
    return new EndpointDescription({
      ...offered, securityMode, securityPolicyUri, userIdentityTokens: [...offered.userIdentityTokens, nobody]
    })
  }
}

// With `options`: user and password, or neither for nobody; policy and mode; certificate, the name of its files in PKI;
// uri, by which the client calls itself, instead of the one in its certificate.
async function connect (name, options) {
  const certificate = options.certificate ?? 'opcua-client-panel'
  const securityMode = MessageSecurityMode[options.mode ?? 'SignAndEncrypt']
  const securityPolicy = POLICIES + (options.policy ?? 'Basic256Sha256')
  const client = OPCUAClient.create({
    applicationName: 'panel',
    clientName: name,
    clientCertificateManager: certificates,
    certificateFile: path.join(pki, `${certificate}.pem`),
    privateKeyFile: path.join(pki, `${certificate}.key.pem`),
    serverCertificate,
    securityPolicy,
    securityMode,
    endpointMustExist: false,
    keepSessionAlive: true,
    connectionStrategy: { maxRetry: 0 }
  })
  if (options.uri) client._getApplicationUri = () => options.uri
  insist(client, securityMode, securityPolicy)
  const identity = options.user
    ? { type: UserTokenType.UserName, userName: options.user, password: options.password }
    : { type: UserTokenType.Anonymous }
  try {
    await client.connect(endpoint)
    const session = await client.createSession(identity)
    const ns = (await session.readNamespaceArray()).indexOf(NAMESPACE)
    sessions.set(name, { client, session, ns, seen: new Map(), events: [] })
    return { refused: null, namespace: ns }
  } catch (error) {
    await client.disconnect().catch(() => {})
    return { refused: String(error.message) }
  }
}

async function close (name) {
  const held = sessions.get(name)
  sessions.delete(name)
  await held?.session.close(true)
  await held?.client.disconnect()
}

// The endpoints that the server tells everybody.
async function endpoints () {
  const client = OPCUAClient.create({
    endpointMustExist: false, clientCertificateManager: certificates, connectionStrategy: { maxRetry: 0 }
  })
  await client.connect(endpoint)
  const found = await client.getEndpoints()
  await client.disconnect()
  return found.map((one) => ({
    policy: one.securityPolicyUri.split('#')[1],
    mode: MessageSecurityMode[one.securityMode],
    tokens: one.userIdentityTokens.map((token) => UserTokenType[token.tokenType])
  }))
}

const children = (session, id) => session.browse({
  nodeId: id,
  referenceTypeId: 'HierarchicalReferences',
  includeSubtypes: true,
  browseDirection: BrowseDirection.Forward,
  nodeClassMask: 0,
  resultMask: 63
})

// Everything below an object, by the names on the way to it: `{ 'Spans.1.Tension': ['Variable', 'ns=2;s=...'] }`.
async function browse (name) {
  const { session } = sessions.get(name)
  const found = {}
  const look = async (id, above) => {
    for (const one of (await children(session, id)).references ?? []) {
      const below = [...above, one.browseName.name]
      found[below.join('.')] = [CLASSES[one.nodeClass], one.nodeId.toString()]
      await look(one.nodeId, below)
    }
  }
  const top = (await children(session, 'ObjectsFolder')).references.find((one) => one.browseName.name === 'Line')
  await look(top.nodeId, ['Line'])
  return found
}

// Unit and range of a variable, by its properties as the server lists them.
async function analog (name, of) {
  const held = sessions.get(name)
  const found = {}
  for (const one of (await children(held.session, nodeId(held, of))).references ?? []) {
    const { value } = await held.session.read({ nodeId: one.nodeId, attributeId: AttributeIds.Value })
    found[one.browseName.name] = value.value
  }
  const { EngineeringUnits: unit, EURange: range } = found
  return {
    unit: unit.unitId, symbol: unit.displayName.text, of: unit.namespaceUri, low: range.low, high: range.high
  }
}

async function read (name, paths) {
  const held = sessions.get(name)
  const asked = paths.map((one) => ({ nodeId: nodeId(held, one), attributeId: AttributeIds.Value }))
  const values = await held.session.read(asked)
  return Object.fromEntries(paths.map((one, i) => [one, told(values[i])]))
}

// Subscribes to variables, and to the events of the Server object; `seen` and `events` tell what has come.
async function watch (name, paths) {
  const held = sessions.get(name)
  const subscription = await held.session.createSubscription2({
    requestedPublishingInterval: 100, requestedLifetimeCount: 1000, requestedMaxKeepAliveCount: 10, publishingEnabled: true
  })
  const statuses = []
  for (const one of paths) {
    const item = await subscription.monitor(
      { nodeId: nodeId(held, one), attributeId: AttributeIds.Value },
      { samplingInterval: 100, queueSize: 10, discardOldest: true }, TimestampsToReturn.Both
    )
    item.on('changed', (dataValue) => {
      const before = held.seen.get(one)
      held.seen.set(one, { changes: (before?.changes ?? 0) + 1, first: before?.first ?? told(dataValue), last: told(dataValue) })
    })
    statuses.push(item.statusCode?.name ?? 'Good')
  }
  const fields = [...EVENT_FIELDS, ...OWN_FIELDS.map((one) => `${held.ns}:${one}`)]
  const events = await subscription.monitor(
    { nodeId: SERVER, attributeId: AttributeIds.EventNotifier },
    { filter: constructEventFilter(fields), queueSize: 100, discardOldest: true }, TimestampsToReturn.Both
  )
  events.on('changed', async (values) => {
    const event = Object.fromEntries([...EVENT_FIELDS, ...OWN_FIELDS].map((one, i) => [one, plain(values[i].value)]))
    const type = await held.session.read({ nodeId: values[0].value, attributeId: AttributeIds.BrowseName })
    held.events.push({ ...event, EventType: type.value.value.name })
  })
  return { refused: [...new Set([...statuses, events.statusCode?.name ?? 'Good'])].filter((one) => one !== 'Good') }
}

// Subscribes to conditions, and asks once more for those that are; `conditions` tells what has come of each.
async function conditions (name) {
  const held = sessions.get(name)
  if (!held.conditions) {
    held.conditions = new Map()
    const subscription = await held.session.createSubscription2({
      requestedPublishingInterval: 100, requestedLifetimeCount: 1000, requestedMaxKeepAliveCount: 10, publishingEnabled: true
    })
    const filter = constructEventFilter(['ConditionId', ...CONDITION_FIELDS], ofType('ConditionType'))
    const item = await subscription.monitor(
      { nodeId: SERVER, attributeId: AttributeIds.EventNotifier },
      { filter, queueSize: 100, discardOldest: true }, TimestampsToReturn.Both
    )
    item.on('changed', ([id, ...fields]) => held.conditions.set(
      id.value.toString(), Object.fromEntries(CONDITION_FIELDS.map((one, i) => [one, plain(fields[i].value)]))
    ))
    const refreshed = await held.session.call({
      objectId: 'i=2782', methodId: 'i=3875', inputArguments: [{ dataType: DataType.UInt32, value: subscription.subscriptionId }]
    })
    if (refreshed.statusCode.name !== 'Good') throw new Error(refreshed.statusCode.name)
  }
  return Object.fromEntries(held.conditions)
}

// An answer to a dialog, by the method of its type.
async function respond (name, dialog, selected) {
  const { session } = sessions.get(name)
  const result = await session.call({
    objectId: dialog, methodId: 'i=9069', inputArguments: [{ dataType: DataType.Int32, value: selected }]
  })
  return result.statusCode.name
}

// A method of the line, with arguments of the types that the server asks for.
async function call (name, method, ...values) {
  const held = sessions.get(name)
  const methodId = nodeId(held, `Line.${method}`)
  const { inputArguments } = await held.session.getArgumentDefinition(methodId)
  const asked = values.map((value, i) => ({ dataType: inputArguments[i].dataType.value, value }))
  const result = await held.session.call({ objectId: nodeId(held, 'Line'), methodId, inputArguments: asked })
  const [ok, sentence] = (result.outputArguments ?? []).map((one) => one.value)
  return { status: result.statusCode.name, ok: ok ?? null, sentence: sentence ?? null }
}

async function write (name, variable, value) {
  const held = sessions.get(name)
  const status = await held.session.write({
    nodeId: nodeId(held, variable),
    attributeId: AttributeIds.Value,
    value: { value: { dataType: DataType.Double, value } }
  })
  return status.name
}

// The last seconds of a variable.
async function history (name, of, seconds) {
  const held = sessions.get(name)
  const end = new Date()
  const result = await held.session.readHistoryValue(nodeId(held, of), new Date(end - 1000 * seconds), end, { numValuesPerNode: 200 })
  return { status: result.statusCode.name, values: (result.historyData?.dataValues ?? []).map(told) }
}

async function open () {
  certificates = new OPCUACertificateManager({ automaticallyAcceptUnknownCertificate: false, rootFolder: path.resolve(folder) })
  await certificates.initialize()
  const [, text] = /-----BEGIN CERTIFICATE-----([^-]+)-----END/.exec(fs.readFileSync(path.join(pki, 'opcua-server.pem'), 'ascii'))
  serverCertificate = Buffer.from(text, 'base64')
  await certificates.trustCertificate(serverCertificate)
}

open().then(() => serve({}, {
  connect,
  close,
  endpoints,
  browse,
  analog,
  read,
  watch,
  call,
  conditions,
  respond,
  write,
  history,
  seen: (name) => Object.fromEntries(sessions.get(name).seen),
  events: (name) => sessions.get(name).events
}))
