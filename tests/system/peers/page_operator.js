'use strict'
// Somebody at the page: Chromium, its keyboard and its screen. What they see and do, the test says, deed by deed.

const { serve } = require('./control')
const axe = require('axe-core')
const { chromium } = require('playwright-core')

const WITHIN_MS = 40000 // longer than the page itself waits for an answer
// Of axe's rules those for WCAG 2.2 A and AA, and what is good practice beside them.
const RULES = ['wcag2a', 'wcag2aa', 'wcag21a', 'wcag21aa', 'wcag22aa', 'best-practice']

let browser, context, page
let bytes = 0 // that have come since the page was opened anew
const asked = [], troubles = [] // where requests went, and what the browser complains of, until the test asks

// A browser of its own: nothing is kept of the one before.
async function open (url, { width = 1280, height = 900, language = 'en-GB', touch = false } = {}) {
  await context?.close()
  context = await browser.newContext({ viewport: { width, height }, locale: language, hasTouch: touch, timezoneId: 'Europe/Berlin' })
  page = await context.newPage()
  page.setDefaultTimeout(WITHIN_MS)
  bytes = 0
  context.on('request', (request) => asked.push(request.url()))
  page.on('pageerror', (error) => troubles.push(error.message))
  // That nobody is logged in, or may not, is an answer; the browser calls it an error.
  page.on('console', (said) => said.type() === 'error' && !/status of 4\d\d/.test(said.text()) && troubles.push(said.text()))
  const wire = await context.newCDPSession(page)
  await wire.send('Network.enable')
  wire.on('Network.loadingFinished', ({ encodedDataLength }) => { bytes += encodedDataLength })
  await page.goto(url, { waitUntil: 'load' })
}

const visible = (selector) => page.locator(selector).filter({ visible: true })

// The violations of what can be seen, the worst first.
async function violations () {
  await page.evaluate(axe.source)
  const found = await page.evaluate((tags) => globalThis.axe.run(document, { runOnly: { type: 'tag', values: tags } }), RULES)
  return found.violations.map(({ id, impact, help, nodes }) => ({ id, impact, help, where: nodes.map(({ target, failureSummary }) => `${target.join(' ')}: ${failureSummary}`) }))
}

// Whether the part that is open is wider than the window, and what sticks out.
const tooWide = () => page.evaluate(() => {
  const wide = document.documentElement.clientWidth
  if (document.documentElement.scrollWidth <= wide) return []
  return [...document.querySelectorAll('body *')].filter((one) => one.getBoundingClientRect().right > wide + 1).slice(0, 5).map((one) => one.outerHTML.slice(0, 120))
})

// The name of what has the focus, as a screen reader says it.
const focused = () => page.evaluate(() => {
  const one = document.activeElement
  return (one.getAttribute('aria-label') ?? one.labels?.[0]?.textContent ?? one.textContent).trim().replace(/\s+/g, ' ')
})

async function tabTo (name, most = 60) {
  for (let i = 0; i < most; i++) {
    await page.keyboard.press('Tab')
    if ((await focused()).startsWith(name)) return
  }
  throw new Error(`${most} times Tab do not lead to ${name}: ${await focused()}`)
}

// How old what the page shows is, s, ten times a second, whether anything new came or not: since the loop measured it.
// Loop and browser go by the clock of one machine.
const ages = (seconds) => page.evaluate((for_ms) => new Promise((resolve) => {
  const every_ms = 100, found = [], clock = document.getElementById('clock'), begin_ms = Date.now()
  let looked_ms = begin_ms, shown_ms = Date.parse(clock.dateTime)
  const looking = setInterval(() => {
    const now_ms = Date.now()
    // While the page was too busy even to look, it showed what it had shown before.
    for (let at_ms = looked_ms + every_ms; at_ms < now_ms - every_ms / 2; at_ms += every_ms) found.push((at_ms - shown_ms) / 1000)
    shown_ms = Date.parse(clock.dateTime)
    found.push((now_ms - shown_ms) / 1000)
    looked_ms = now_ms
    if (now_ms - begin_ms >= for_ms) { clearInterval(looking); resolve(found) }
  }, every_ms)
}), seconds * 1000)

// From Enter, with name and password typed in, until the line is seen, s.
async function enter () {
  const begin_ms = performance.now()
  await page.keyboard.press('Enter')
  await visible('#picture svg').first().waitFor()
  return (performance.now() - begin_ms) / 1000
}

// What fails is an answer, too: the browser goes on with the next test.
const answered = (deed) => async (...args) => {
  try {
    return { came: await deed(...args) ?? null }
  } catch (error) {
    return { failed: error.message }
  }
}

chromium.launch({ executablePath: process.argv[2], chromiumSandbox: false, args: ['--disable-gpu'] }).then((launched) => {
  browser = launched
  const deeds = {
    open,
    click: (selector) => visible(selector).first().click(),
    press: (key) => page.keyboard.press(key),
    write: (text) => page.keyboard.type(text),
    fill: (selector, text) => visible(selector).first().fill(text),
    choose: (selector, value) => visible(selector).first().selectOption(value),
    // Waits until it can be seen, with this text in it; answers with all of its text.
    see: async (selector, text = '') => {
      const found = visible(selector).filter({ hasText: text }).first()
      await found.waitFor()
      return (await found.evaluate((one) => one.innerText ?? one.textContent)).trim()
    },
    gone: (selector) => page.locator(selector).filter({ visible: true }).first().waitFor({ state: 'detached' }),
    texts: (selector) => visible(selector).evaluateAll((all) => all.map((one) => (one.innerText ?? one.textContent).trim())),
    content: (selector) => page.locator(selector).first().textContent(), // also of what only a screen reader has
    value: (selector) => visible(selector).first().inputValue(),
    focus: (selector) => visible(selector).first().focus(),
    cut: (urls, times) => context.route(urls, (route) => route.abort(), { times }), // as a network does for a while
    count: (selector) => visible(selector).count(),
    part: async (name) => { await page.evaluate((hash) => { location.hash = hash }, name); await visible(`#view-${name}`).waitFor() },
    size: (width, height) => page.setViewportSize({ width, height }),
    forget_session: () => context.clearCookies(), // as the server does after a while
    violations,
    too_wide: tooWide,
    focused,
    tab_to: tabTo,
    ages,
    enter_s: enter,
    first_paint_s: () => page.evaluate(() => performance.getEntriesByName('first-contentful-paint')[0].startTime / 1000),
    bytes: () => bytes,
    asked: () => asked.splice(0),
    troubles: () => troubles.splice(0),
    picture: async (path, whole = true) => { await page.screenshot({ path, fullPage: whole, animations: 'disabled' }) }
  }
  serve({ version: browser.version() }, Object.fromEntries(Object.entries(deeds).map(([name, deed]) => [name, answered(deed)])))
})
