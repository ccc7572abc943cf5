'use strict'
// The test's own wire to a peer: one JSON value a line on standard input, one answer a line on standard output.
// Nothing of it is seen by the gateway.

const readline = require('node:readline')

// Libraries talk on standard output, too: require this file first.
for (const level of ['log', 'info', 'debug']) console[level] = console.error

// `deeds` are functions by name, with the arguments that the test gives. The peer ends with its standard input.
function serve (ready, deeds) {
  const say = (value) => process.stdout.write(JSON.stringify(value) + '\n')
  say(ready)
  const lines = readline.createInterface({ input: process.stdin })
  lines.on('line', async (line) => {
    const [name, ...args] = JSON.parse(line)
    say(await deeds[name](...args) ?? null)
  })
  lines.on('close', () => process.exit(0))
}

module.exports = { serve }
