/* What the matcher does at a pixel of one level: the same rules for a processor, eight pixels at a time, and for a GPU.
   No recursion, no allocation, no state. All costs are integers, candidates come in a fixed order and only a lower cost
   wins, so that results depend neither on the machine nor on the number of lanes. */
#pragma once
#include "lanes.h"

enum {
  FAR = 1 << 25,       /* cost above every cost */
  FARTHEST_OFF = 2047, /* most that the band costs: as much as the greatest distance */
  TRUNCATION = 2,      /* pixels: beyond this a step to a neighbour costs no more, so that depth edges stay */
  CENTRES = 5          /* predictions of a pixel: its parent's, and those beside, above and below the parent */
};
#define SHARP 3.0f         /* byte steps a pixel: a softer band hardly says in which row to search */
#define LEAST_NORMAL 1e-12f /* length below which a normal is none: there is no band */

typedef struct { const uint64_t *words; int32_t rows, cols; } Image; /* feature vectors of an image, or of a window */
typedef struct { double f[9], cost; } Band;                          /* fundamental matrix; cost of a pixel off a line */
typedef struct { float a, b, c; } Line; /* |a u + b v + c|: cost of displacement (u, v), which is off the line */
typedef struct { float t[7], cost; } RowLines;                       /* lines of a row: polynomials of the column */
typedef struct { int32_t u, v; } Shift;                              /* columns and rows from a left to a right pixel */
typedef struct {
  Image left, right;
  Band band;
} Pair;
typedef struct { const int16_t *u, *v; int32_t cols; } Parents;      /* displacements of the coarser level */

RULE int32_t pack(int32_t u, int32_t v) { return (int32_t)((uint32_t)v << 16 | (u & 0xFFFF)); }
RULE Shift unpack(int32_t shift) { return (Shift){(int16_t)shift, shift >> 16}; }
RULE int32_t within(int32_t index, int32_t size) { return index < 0 ? 0 : index < size ? index : size - 1; }

/* Lines of row y as polynomials of the column; added up in double precision, so that nothing cancels where rows are
   nearly lines. */
RULE RowLines row_lines(const Band *band, double y) {
  const double *f = band->f;
  double a = f[1] * y + f[2], b = f[4] * y + f[5], c = f[8] + f[7] * y + b * y;
  return (RowLines){{(float)a, (float)f[0], (float)b, (float)f[3], (float)c, (float)(f[6] + a + f[3] * y), (float)f[0]},
                    (float)band->cost};
}
RULE Line line_at(RowLines row, float x, float cost) {
  float a = row.t[0] + row.t[1] * x, b = row.t[2] + row.t[3] * x, c = row.t[4] + x * (row.t[5] + x * row.t[6]);
  float norm = sqrtf(a * a + b * b), scale = cost / (norm > LEAST_NORMAL ? norm : LEAST_NORMAL);
  return (Line){a * scale, b * scale, c * scale};
}
RULE int32_t off_line(Line line, Shift s) {
  float off = fabsf(line.a * (float)s.u + line.b * (float)s.v + line.c);
  return (int32_t)(off < FARTHEST_OFF ? off : FARTHEST_OFF);
}

/* ---- search: around predictions, for the four pixels of a parent ---- */

typedef struct { int32_t u, count, centre, v, cross; } Strip; /* count columns from u on of row v; see try_strip */
typedef struct { int32_t x, y, shift[4], cost[4]; } Children; /* the first pixel, and the best so far of two by two */

RULE int32_t inside(const Image *image, int32_t x, int32_t y) {
  return x >= 0 && y >= 0 && x < image->cols && y < image->rows;
}
RULE int64_t place(const Image *image, int32_t x, int32_t y) { return (int64_t)y * image->cols + x; }

RULE void try_pixel(const Pair *pair, Line line, Children *best, int n, Shift s) {
  int32_t x = best->x + (n & 1), y = best->y + (n >> 1), xr = x + s.u, yr = y + s.v;
  if (!inside(&pair->right, xr, yr)) return;
  int32_t cost = distance(pair->left.words[place(&pair->left, x, y)],
                          pair->right.words[place(&pair->right, xr, yr)]) + off_line(line, s);
  if (cost < best->cost[n]) best->cost[n] = cost, best->shift[n] = pack(s.u, s.v);
}
/* Candidates of a strip, in this order: the centre's column, the others; where it is crossed, the rows above and below
   the centre. Near the border of an image pixel by pixel. */
RULE void try_strip_singly(const Pair *pair, Line line, Strip strip, Children *best) {
  for (int n = 0; n < 4; n++) {
    if (best->x + (n & 1) >= pair->left.cols || best->y + (n >> 1) >= pair->left.rows) continue;
    if (strip.centre >= strip.u && strip.centre < strip.u + strip.count)
      try_pixel(pair, line, best, n, (Shift){strip.centre, strip.v});
    for (int k = 0; k < strip.count; k++) try_pixel(pair, line, best, n, (Shift){strip.u + k, strip.v});
    if (!strip.cross) continue;
    try_pixel(pair, line, best, n, (Shift){strip.centre, strip.v - 1});
    try_pixel(pair, line, best, n, (Shift){strip.centre, strip.v + 1});
  }
}
#ifdef __CUDACC__
#define try_strip try_strip_singly
#else
RULE void try_square(const Pair *pair, Square own, int64_t at, int32_t off, int32_t shift, Children *best) {
  Four cost = square_distances(own, square(pair->right.words, at, pair->right.cols)) + off, least, chosen;
  __builtin_memcpy(&least, best->cost, sizeof least);
  __builtin_memcpy(&chosen, best->shift, sizeof chosen);
  Four better = cost < least, tried = (Four){} + shift;
  least = PICK(better, cost, least), chosen = PICK(better, tried, chosen);
  __builtin_memcpy(best->cost, &least, sizeof least);
  __builtin_memcpy(best->shift, &chosen, sizeof chosen);
}
RULE void try_strip(const Pair *pair, Line line, Strip strip, Children *best) {
  int32_t x = best->x, y = best->y, cols = pair->left.cols, right_cols = pair->right.cols;
  int32_t yr = y + strip.v;
  if (x + 1 >= cols || y + 1 >= pair->left.rows || x + strip.u < 0 || x + strip.u + strip.count >= right_cols ||
      yr < strip.cross || yr + 1 + strip.cross >= pair->right.rows) {
    try_strip_singly(pair, line, strip, best);
    return;
  }
  Square own = square(pair->left.words, (int64_t)y * cols + x, cols);
  Eight u = (Eight){0, 1, 2, 3, 4, 5, 6, 7} + strip.u, v = (Eight){} + strip.v;
  Eight off = magnitude(line.a * floats(u) + line.b * floats(v) + line.c, FARTHEST_OFF);
  int64_t row = (int64_t)yr * right_cols + x;
  int32_t offs[LANES], centre = strip.centre - strip.u;
  __builtin_memcpy(offs, &off, sizeof offs);
  if (centre >= 0 && centre < strip.count)
    try_square(pair, own, row + strip.centre, offs[centre], pack(strip.centre, strip.v), best);
  for (int k = 0; k < strip.count; k++)
    try_square(pair, own, row + strip.u + k, offs[k], pack(strip.u + k, strip.v), best);
  for (int side = -strip.cross; side <= strip.cross; side += 2) {
    if (!strip.cross) break;
    Shift s = {strip.centre, strip.v + side};
    try_square(pair, own, row + side * right_cols + s.u, off_line(line, s), pack(s.u, s.v), best);
  }
}
#endif

/* Along the rows through the centres, and along the column through the parent's. Centres of the parent's row whose
   strips touch are searched together, where eight columns hold them. */
RULE void search_rows(const Pair *pair, Line line, const int32_t centres[CENTRES], Shift reach, Children *best) {
  Shift own = unpack(centres[0]);
  int32_t wide = 2 * reach.u + 1, most = wide < 8 - wide ? wide : 8 - wide, low = own.u, high = own.u, apart_from = 0;
  for (int k = 1; k < CENTRES; k++) {
    Shift other = unpack(centres[k]);
    if (other.v == own.v && high - other.u <= most && other.u - low <= most) {
      low = other.u < low ? other.u : low;
      high = other.u > high ? other.u : high;
    } else {
      apart_from |= 1 << k;
    }
  }
  try_strip(pair, line, (Strip){low - reach.u, high - low + wide, own.u, own.v, reach.v}, best);
  for (int k = 1; k < CENTRES; k++) {
    Shift other = unpack(centres[k]);
    if (apart_from >> k & 1) try_strip(pair, line, (Strip){other.u - reach.u, wide, other.u, other.v, 0}, best);
  }
}
/* The same for any reach; where the band is soft, the whole rectangle about each centre. */
RULE void search_rectangles(const Pair *pair, Line line, const int32_t centres[CENTRES], Shift reach, Children *best) {
  int32_t soft = pair->band.cost < SHARP;
  for (int k = 0; k < CENTRES; k++) {
    Shift centre = unpack(centres[k]);
    if (k > 0 && centres[k] == centres[0]) continue;
    for (int dv = -reach.v; dv <= reach.v; dv++) {
      if (!soft && k > 0 && dv != 0) continue;
      int32_t side = soft || dv == 0 ? reach.u : 0;
      for (int first = -side; first <= side; first += 8) {
        int32_t count = side + 1 - first < 8 ? side + 1 - first : 8;
        try_strip(pair, line, (Strip){centre.u + first, count, centre.u, centre.v + dv, 0}, best);
      }
    }
  }
}
/* Doubled displacement of a parent, moved towards its line, by a pixel at most: a coarse fit may be wrong by more. */
RULE int32_t centre_of(const Pair *pair, const Parents *up, RowLines row, int32_t i, int32_t j) {
  Shift s = {2 * up->u[(int64_t)j * up->cols + i], 2 * up->v[(int64_t)j * up->cols + i]};
  if (pair->band.cost < SHARP) return pack(s.u, s.v);
  Line line = line_at(row, (float)(2 * i) + 0.5f, 1.0f);
  float off = line.a * (float)s.u + line.b * (float)s.v + line.c;
  off = off < -1.0f ? -1.0f : off > 1.0f ? 1.0f : off;
  return pack((int32_t)((float)s.u - rintf(off * line.a)), (int32_t)((float)s.v - rintf(off * line.b)));
}
/* The best displacements of the four pixels of the parent `at`. With nothing inside the right image the prediction, the
   first of the centres, stays. */
RULE Children search_parent(const Pair *pair, RowLines row, const int32_t centres[CENTRES], Shift at, Shift reach) {
  Line line = line_at(row, (float)(2 * at.u) + 0.5f, row.cost);
  int32_t own = centres[0];
  Children best = {2 * at.u, 2 * at.v, {own, own, own, own}, {FAR, FAR, FAR, FAR}};
  /* A row about a centre fits into eight columns up to a reach of 3, and a cross has one row to either side. */
  if (pair->band.cost >= SHARP && reach.u <= 3 && reach.v <= 1) search_rows(pair, line, centres, reach, &best);
  else search_rectangles(pair, line, centres, reach, &best);
  return best;
}

/* ---- propagation: from the neighbours ---- */

typedef struct {
  int32_t smoothness, rounds; /* cost of roughness; number of rounds */
  int32_t beside;             /* tried beside a displacement: nothing (0), columns (1), rows as well (2) */
} Smoothing;
typedef struct { Eight shift, cost, total; } Settled;     /* total: with the cost of roughness */
typedef struct { EightFloat a, b, c; } Lines;

RULE Lines lines_at(RowLines row, EightFloat x) {
  EightFloat a = row.t[0] + row.t[1] * x, b = row.t[2] + row.t[3] * x, c = row.t[4] + x * (row.t[5] + x * row.t[6]);
  EightFloat scale = row.cost / length(a, b, LEAST_NORMAL);
  return (Lines){a * scale, b * scale, c * scale};
}
RULE Eight roughness(Eight tried, const Eight near[4]) {
  Eight total = tried & 0, most = total + TRUNCATION;
  for (int k = 0; k < 4; k++) total += least_of(apart(near[k], tried), most);
  return total;
}
typedef struct { const Pair *pair; Words words; Eight x; int32_t y; Lines line; const Eight *near; int32_t smoothness; } Look;

/* Take a displacement where it costs less than the best so far, and where `fresh`. */
RULE void attempt(const Look *look, Eight tried, Eight fresh, Settled *best) {
  const Image *right = &look->pair->right;
  Eight u = columns(tried), v = tried >> 16, x = look->x + u;
  Eight y = v + look->y;
  Eight inside = below(x, right->cols) & below(y, right->rows) & fresh;
  Eight cost = distances(look->words, words_at(right->words, (y * right->cols + x) & inside));
  cost += magnitude(look->line.a * floats(u) + look->line.b * floats(v) + look->line.c, FARTHEST_OFF);
  Eight total = cost + look->smoothness * roughness(tried, look->near), better = LESS(total, best->total) & inside;
  best->shift = PICK(better, tried, best->shift);
  best->cost = PICK(better, cost, best->cost);
  best->total = PICK(better, total, best->total);
}
/* The best of a pixel's own displacement, those beside it, and those of the neighbours above, left, right, below. */
RULE Settled settle(const Look *look, Eight own, Eight stay, int32_t beside) {
  const Eight *near = look->near;
  Settled best = {own, stay, stay + look->smoothness * roughness(own, near)};
  Eight all = ~(own & 0);
  if (beside > 0) {
    attempt(look, moved(own, -1, 0), all, &best);
    attempt(look, moved(own, 1, 0), all, &best);
  }
  if (beside > 1) {
    attempt(look, moved(own, 0, -1), all, &best);
    attempt(look, moved(own, 0, 1), all, &best);
  }
  for (int k = 0; k < 4; k++) {
    /* A neighbour's that is a column beside the own one has been tried, or is for `beside` to try. */
    Eight row = SAME(near[k] >> 16, own >> 16), step = columns(near[k]) - columns(own);
    Eight fresh = ~(row & LESS(step, (step & 0) + 2) & LESS((step & 0) - 2, step));
    for (int j = 0; j < k; j++) fresh &= ~SAME(near[k], near[j]);
    if (any(fresh)) attempt(look, near[k], fresh, &best);
  }
  return best;
}
