// SPDX-License-Identifier: Apache-2.0
// Score, gradient and Hessian sums of a scan at many poses; OpenCL C 1.2.
//
// The same arithmetic as the compiled backend's kernel, in the same order: the points of a chunk in order,
// their neighbours in the order of columns, cells and heights.  Without atomic additions: each chunk of 128
// points at each pose has its own row of sums, so that results are the same to the bit, in repeats and batches.
//
// Macros that the program is built with (opencl_backend.py):
//   DOUBLE          1: double throughout; 0: float throughout
//   IN_PLACE        1: tables and their arrays are at addresses; 0: at offsets into the pool, a buffer
//   SEARCH          1, 7 or 27: number of lattice places to search
//   MOST            largest number of neighbours of a point; the nearest are taken
//   ITEM_PER_CHUNK  1: one work-item sums a chunk, for processors; 0: one work-item a point, for GPUs

#if DOUBLE
#pragma OPENCL EXTENSION cl_khr_fp64 : enable
typedef double real;
#define R(x) x
#else
typedef float real;
#define R(x) x##f
#endif

#define CHUNK 128
#define SUMS 40
#define USED 39
#define SHIFT 3  // the directory has a place for each square of 8 x 8 columns
#define PASS 13  // sums in local memory at a time, for all points of a chunk
#define POSE 40  // numbers of a pose: the transform's three rows, then three derivatives of the rotation
#define NEGLIGIBLE R(36.7)

#if IN_PLACE
#define AT(type, base) ((__global const type *)(size_t)(base))
#else
#define AT(type, base) ((__global const type *)(pool + (base)))
#endif

// columns of the table of cells, VoxelMap.table
enum { LATTICE, MEAN, INVERSE, I0, J0, K0, NK, SI, SJ, SK, VOXELS, NI, NJ, COLUMNS };

#if SEARCH == 1
#define SEARCHED 1
__constant int searched[SEARCHED][4] = {{0, 0, 0, 0}};
#elif SEARCH == 7
#define SEARCHED 5
__constant int searched[SEARCHED][4] = {{0, 0, -1, 1}, {-1, 0, 0, 0}, {1, 0, 0, 0}, {0, -1, 0, 0}, {0, 1, 0, 0}};
#else
#define SEARCHED 9
__constant int searched[SEARCHED][4] = {{-1, -1, -1, 1}, {-1, 0, -1, 1}, {-1, 1, -1, 1},
                                        {0, -1, -1, 1},  {0, 0, -1, 1},  {0, 1, -1, 1},
                                        {1, -1, -1, 1},  {1, 0, -1, 1},  {1, 1, -1, 1}};
#endif

typedef struct {
    __global const uchar *pool;
    __global const long *table;
#if DOUBLE
    __global const double *origins;
#endif
    __global const int *square_start;
    __global const int *square_cell;
    int lead_i, lead_j, squares;  // of the directory: columns before the box, squares in a row
    int box_i, box_j, ni, nj;     // box of all columns; its corner is relative to the pose's lattice place
    int ref_i, ref_j, ref_k;      // lattice place of the pose, to which float coordinates are relative
    real leaf, inverse_leaf, radius2, d1, d2;
} Map;

// Sums over a point's neighbours: score, best share, sum of w q, sum of w (C - d2 q q^T).
typedef struct {
    real score, best, g0, g1, g2, h00, h01, h02, h11, h12, h22;
} Share;

static inline void add_share(__global const real *C, real dx, real dy, real dz, real d1, real d2, Share *sum) {
    const real c00 = C[0], c01 = C[1], c02 = C[2], c11 = C[3], c12 = C[4], c22 = C[5];
    const real q0 = c00 * dx + c01 * dy + c02 * dz;
    const real q1 = c01 * dx + c11 * dy + c12 * dz;
    const real q2 = c02 * dx + c12 * dy + c22 * dz;
    const real exponent = R(0.5) * d2 * (dx * q0 + dy * q1 + dz * q2);
    if (!(exponent >= R(0.0) && exponent < NEGLIGIBLE))
        return;
    const real e = exp(-exponent);
    const real share = -d1 * e;
    const real w = d1 * d2 * e;
    const real v = w * d2;
    sum->score += share;
    sum->best = fmax(sum->best, share);
    sum->g0 += w * q0;
    sum->g1 += w * q1;
    sum->g2 += w * q2;
    sum->h00 += w * c00 - v * q0 * q0;
    sum->h01 += w * c01 - v * q0 * q1;
    sum->h02 += w * c02 - v * q0 * q2;
    sum->h11 += w * c11 - v * q1 * q1;
    sum->h12 += w * c12 - v * q1 * q2;
    sum->h22 += w * c22 - v * q2 * q2;
}

// Visit a point's neighbours in order and return how many there are.
// sum: receives the terms of neighbours up to (*far, *rank).  If null: find the neighbour after (*far, *rank) by
// distance, then by order, and write its distance and rank there.
static inline int visit(const Map map, real px, real py, real pz, int i, int j, int k, real *far, int *rank,
                        Share *sum) {
    __global const uchar *pool = map.pool;
    int count = 0;
    real next = INFINITY;
    int next_rank = 0;
    for (int column = 0; column < SEARCHED; column++) {
        const int ci = i + searched[column][0];
        const int cj = j + searched[column][1];
        if (ci < 0 || ci >= map.ni || cj < 0 || cj >= map.nj)
            continue;
        const int place = ((ci + map.lead_i) >> SHIFT) * map.squares + ((cj + map.lead_j) >> SHIFT);
        const int end = map.square_start[place + 1];
        for (int entry = map.square_start[place]; entry < end; entry++) {
            const int cell = map.square_cell[entry];
            __global const long *row = map.table + cell * COLUMNS;
            const int across = ci + map.box_i + map.ref_i - (int)row[I0];
            const int along = cj + map.box_j + map.ref_j - (int)row[J0];
            if (across < 0 || across >= (int)row[NI] || along < 0 || along >= (int)row[NJ])
                continue;
            const int k0 = (int)row[K0] - map.ref_k;
            const int low = max(k + searched[column][2] - k0, 0);
            const int high = min(k + searched[column][3] - k0, (int)row[NK] - 1);
            if (low > high)
                continue;
            const int step = (int)row[SK];
            __global const int *lattice = AT(int, row[LATTICE]) + (across * (int)row[SI] + along * (int)row[SJ]);
            __global const real *mean = AT(real, row[MEAN]);
            __global const real *inverse = AT(real, row[INVERSE]);
            const int voxels = (int)row[VOXELS];
#if DOUBLE
            const real x = px - map.origins[cell * 3];
            const real y = py - map.origins[cell * 3 + 1];
            const real z = pz - map.origins[cell * 3 + 2];
#else
            // the cell's corner, near enough to the pose's lattice place to be exact
            const real x = px - ((int)row[I0] - map.ref_i) * map.leaf;
            const real y = py - ((int)row[J0] - map.ref_j) * map.leaf;
            const real z = pz - k0 * map.leaf;
#endif
            for (int dk = low; dk <= high; dk++) {
                const int voxel = lattice[dk * step];
                if (voxel < 0 || voxel >= voxels)
                    continue;
                __global const real *C = inverse + voxel * 6;
                if (!(C[0] > R(0.0)))  // the variant refuses this voxel
                    continue;
                const real dx = x - mean[voxel * 3];
                const real dy = y - mean[voxel * 3 + 1];
                const real dz = z - mean[voxel * 3 + 2];
                const real distance2 = dx * dx + dy * dy + dz * dz;
                if (distance2 > map.radius2)
                    continue;
                if (sum) {
                    if (distance2 < *far || (distance2 == *far && count <= *rank))
                        add_share(C, dx, dy, dz, map.d1, map.d2, sum);
                } else if ((distance2 > *far || (distance2 == *far && count > *rank)) && distance2 < next) {
                    next = distance2;
                    next_rank = count;
                }
                count++;
            }
        }
    }
    if (!sum) {
        *far = next;
        *rank = next_rank;
    }
    return count;
}

// Write a point's part of each sum; returns whether it has a neighbour.
static inline bool point_sums(const Map map, __global const real *pose, real x, real y, real z, real *s) {
    const real px = pose[0] * x + pose[1] * y + pose[2] * z + pose[3];
    const real py = pose[4] * x + pose[5] * y + pose[6] * z + pose[7];
    const real pz = pose[8] * x + pose[9] * y + pose[10] * z + pose[11];
    const real fi = floor(px * map.inverse_leaf) - map.box_i;
    const real fj = floor(py * map.inverse_leaf) - map.box_j;
    const real fk = floor(pz * map.inverse_leaf);
    // outside the map or not a number; this test also keeps the conversions to integers defined
    if (!(fi >= -1 && fi <= map.ni && fj >= -1 && fj <= map.nj && fabs(fk) < R(1073741824.0)))
        return false;
    const int i = (int)fi, j = (int)fj, k = (int)fk;
    Share sum = {0};
    real far = INFINITY;
    int rank = 0;
    const int count = visit(map, px, py, pz, i, j, k, &far, &rank, &sum);
    if (count == 0)
        return false;
    const int used = min(count, MOST);
    if (count > MOST) {
        // seldom: find the farthest neighbour within the limit, step by step, then add again
        far = -1;
        rank = -1;
        for (int taken = 0; taken < MOST; taken++)
            visit(map, px, py, pz, i, j, k, &far, &rank, 0);
        const Share none = {0};
        sum = none;
        visit(map, px, py, pz, i, j, k, &far, &rank, &sum);
    }
    s[0] = sum.score;
    s[1] = sum.best;
    s[2] = 1;
    s[3] = used;
    s[4] = count > MOST;
    s[5] = count - used;
    const real g0 = sum.g0, g1 = sum.g1, g2 = sum.g2;
    const real h00 = sum.h00, h01 = sum.h01, h02 = sum.h02, h11 = sum.h11, h12 = sum.h12, h22 = sum.h22;
    s[6] = g0;
    s[7] = g1;
    s[8] = g2;
    s[9] = g0 * x;
    s[10] = g0 * y;
    s[11] = g0 * z;
    s[12] = g1 * x;
    s[13] = g1 * y;
    s[14] = g1 * z;
    s[15] = g2 * x;
    s[16] = g2 * y;
    s[17] = g2 * z;
    s[18] = h00;
    s[19] = h01;
    s[20] = h02;
    s[21] = h11;
    s[22] = h12;
    s[23] = h22;
    // columns of J: how the point moves with roll, pitch, yaw
    __global const real *M = pose + 12;
    const real ry = M[3] * x + M[4] * y + M[5] * z;
    const real rz = M[6] * x + M[7] * y + M[8] * z;
    const real ux = M[9] * x + M[10] * y + M[11] * z;
    const real uy = M[12] * x + M[13] * y + M[14] * z;
    const real uz = M[15] * x + M[16] * y + M[17] * z;
    const real wx = M[18] * x + M[19] * y;
    const real wy = M[21] * x + M[22] * y;
    const real wz = M[24] * x + M[25] * y;
    // B J
    const real l00 = h01 * ry + h02 * rz, l10 = h11 * ry + h12 * rz, l20 = h12 * ry + h22 * rz;
    const real l01 = h00 * ux + h01 * uy + h02 * uz;
    const real l11 = h01 * ux + h11 * uy + h12 * uz;
    const real l21 = h02 * ux + h12 * uy + h22 * uz;
    const real l02 = h00 * wx + h01 * wy + h02 * wz;
    const real l12 = h01 * wx + h11 * wy + h12 * wz;
    const real l22 = h02 * wx + h12 * wy + h22 * wz;
    s[24] = l00;
    s[25] = l01;
    s[26] = l02;
    s[27] = l10;
    s[28] = l11;
    s[29] = l12;
    s[30] = l20;
    s[31] = l21;
    s[32] = l22;
    // J^T B J
    s[33] = ry * l10 + rz * l20;
    s[34] = ry * l11 + rz * l21;
    s[35] = ry * l12 + rz * l22;
    s[36] = ux * l01 + uy * l11 + uz * l21;
    s[37] = ux * l02 + uy * l12 + uz * l22;
    s[38] = wx * l02 + wy * l12 + wz * l22;
    return true;
}

// Work-items: (chunks, poses), or (points rounded up to whole chunks, poses) in groups of (128, 1).
__kernel void evaluate(__global const real *restrict source, const int points,
                       __global const real *restrict poses, __global const int *restrict places,
                       __global real *restrict rows, __global const uchar *restrict pool, const long table_at,
                       const long origins_at, const long start_at, const long cell_at, const int box_i,
                       const int box_j, const int ni, const int nj, const int lead_i, const int lead_j,
                       const int squares, const real leaf, const real inverse_leaf,
                       const real radius2, const real d1, const real d2) {
    const int at = get_global_id(1);
    __global const real *pose = poses + at * POSE;
    __global const int *place = places + at * 3;
    Map map;
    map.pool = pool;
    map.table = AT(long, table_at);
#if DOUBLE
    map.origins = AT(double, origins_at);
#endif
    map.square_start = AT(int, start_at);
    map.square_cell = AT(int, cell_at);
    map.lead_i = lead_i;
    map.lead_j = lead_j;
    map.squares = squares;
    map.ref_i = place[0];
    map.ref_j = place[1];
    map.ref_k = place[2];
    map.box_i = box_i - map.ref_i;
    map.box_j = box_j - map.ref_j;
    map.ni = ni;
    map.nj = nj;
    map.leaf = leaf;
    map.inverse_leaf = inverse_leaf;
    map.radius2 = radius2;
    map.d1 = d1;
    map.d2 = d2;
    const int chunks = (points + CHUNK - 1) / CHUNK;
#if ITEM_PER_CHUNK
    const int chunk = get_global_id(0);
    const int end = min((chunk + 1) * CHUNK, points);
    real sums[SUMS];
    for (int slot = 0; slot < SUMS; slot++)
        sums[slot] = 0;
    for (int point = chunk * CHUNK; point < end; point++) {
        real s[USED];
        if (point_sums(map, pose, source[3 * point], source[3 * point + 1], source[3 * point + 2], s))
            for (int slot = 0; slot < USED; slot++)
                sums[slot] += s[slot];
    }
    __global real *row = rows + ((long)at * chunks + chunk) * SUMS;
    for (int slot = 0; slot < SUMS; slot++)
        row[slot] = sums[slot];
#else
    __local real shared[PASS * (CHUNK + 1)];
    const int point = get_global_id(0);
    const int mine = get_local_id(0);
    const int chunk = get_group_id(0);
    real s[USED];
    for (int slot = 0; slot < USED; slot++)
        s[slot] = 0;
    if (point < points)
        point_sums(map, pose, source[3 * point], source[3 * point + 1], source[3 * point + 2], s);
    __global real *row = rows + ((long)at * chunks + chunk) * SUMS;
    for (int first = 0; first < USED; first += PASS) {
        for (int slot = 0; slot < PASS; slot++)
            shared[slot * (CHUNK + 1) + mine] = s[first + slot];
        barrier(CLK_LOCAL_MEM_FENCE);
        if (mine < PASS) {
            real sum = 0;
            for (int other = 0; other < CHUNK; other++)
                sum += shared[mine * (CHUNK + 1) + other];
            row[first + mine] = sum;
        }
        barrier(CLK_LOCAL_MEM_FENCE);
    }
    if (mine == 0)
        row[USED] = 0;
#endif
}
