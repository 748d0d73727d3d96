// Requests to the agent that serves this page, and to no other host.
//
// The token stays in this tab, in the session's storage and in a header, never in an address.

const KEY = 'ros2probe-token';

/** A failed request: the agent's problem details, or a broken connection. */
export class Refusal extends Error {
  /** @param {number} status 0 without an answer @param {string} detail @param {string} code */
  constructor(status, detail, code = '') {
    super(detail);
    this.status = status;
    this.code = code;
  }

  /** Returns whether a token with more rights would help. */
  get needsToken() {
    return this.status === 401 || (this.status === 403 && this.code === 'needs-socket');
  }
}

export function token() {
  return sessionStorage.getItem(KEY);
}

/** @param {string|null} value */
export function keepToken(value) {
  if (value) sessionStorage.setItem(KEY, value);
  else sessionStorage.removeItem(KEY);
}

/** Returns an endpoint's address, relative to the page's. @param {string} path */
export function endpoint(path) {
  return new URL(path.replace(/^\//, ''), document.baseURI.split('#')[0]).href;
}

/**
 * Returns the path of a topic or node: the whole name is one segment, with its leading slash.
 * @param {string} kind `topics`, `nodes` or `watch`
 * @param {string} name
 * @param {string} [rest]
 */
export function named(kind, name, rest = '') {
  return `${kind}/${encodeURIComponent(name)}${rest}`;
}

/**
 * @param {string} path
 * @param {RequestInit} [options]
 * @returns {Promise<Response>} an answer of 2xx
 * @throws {Refusal}
 */
export async function request(path, options = {}) {
  const headers = new Headers(options.headers);
  const own = token();
  if (own) headers.set('Authorization', `Bearer ${own}`);
  let response;
  try {
    response = await fetch(endpoint(path), { ...options, headers, cache: 'no-store' });
  } catch (error) {
    if (options.signal?.aborted) throw error;
    throw new Refusal(0, 'the agent does not answer');
  }
  if (response.ok) return response;
  let problem = {};
  try {
    problem = await response.json();
  } catch {
    // A proxy in between may answer in another format.
  }
  const { detail, title, type, code, mistakes } = /** @type {any} */ (problem);
  const text = [detail ?? title ?? `status ${response.status}`, ...(mistakes ?? [])].join('; ');
  const name = code ?? String(type ?? '').split(/[/:#]/).pop() ?? '';
  throw new Refusal(response.status, text, name);
}

/** @param {string} path @param {RequestInit} [options] @returns {Promise<any>} */
export async function json(path, options) {
  const response = await request(path, options);
  return response.status === 204 ? null : response.json();
}

/** @param {string} path @param {unknown} [body] */
export function post(path, body = {}) {
  return json(path, {
    method: 'POST',
    headers: { 'Content-Type': 'application/json' },
    body: JSON.stringify(body),
  });
}

/** @param {string} path */
export function remove(path) {
  return json(path, { method: 'DELETE' });
}
