// geokit_vdb_worker: reads one untrusted .vdb file, in a process that a damaged file may crash.
//
//   geokit_vdb_worker inspect MEMORY CPU_SECONDS FILE
//   geokit_vdb_worker read MEMORY CPU_SECONDS FILE SPOOL_FOLDER [GRID...]
//
// MEMORY is in bytes. One line of JSON goes to stdout (see bridge.h), and nothing else: what libraries print there goes to
// stderr. Buffers go into files in SPOOL_FOLDER.
// Exit status: 0 done, 1 the JSON holds an error, 2 wrong usage. Anything else, or a signal, is a crash.

#include "bridge.h"

#include <tbb/global_control.h>

#include <algorithm>
#include <cstdio>
#include <cstdlib>
#include <new>
#include <string>
#include <thread>
#include <vector>

#include <csignal>
#include <malloc.h>
#include <sys/prctl.h>
#include <sys/resource.h>
#include <unistd.h>

namespace {

// Conversion is bound by memory, so more threads gain nothing, and each one's stack and malloc arena count as address
// space.
constexpr unsigned kMaxThreads = 8;
constexpr int kMaxArenas = 4;

// Address space that is reserved but not used (thread stacks, malloc arenas, libraries), allowed in addition to the
// limit.
constexpr rlim_t kReservedSpace = rlim_t(768) << 20;

void limit(int resource, rlim_t value)
{
    const rlimit bounds{value, value};
    ::setrlimit(static_cast<__rlimit_resource>(resource), &bounds);
}

void restrain(rlim_t memory, rlim_t cpu_seconds)
{
    ::prctl(PR_SET_PDEATHSIG, SIGKILL); // do not outlive the parent process
    limit(RLIMIT_CORE, 0);
    ::prctl(PR_SET_DUMPABLE, 0);
    limit(RLIMIT_AS, memory + kReservedSpace);
    limit(RLIMIT_FSIZE, memory);
    ::signal(SIGXFSZ, SIG_IGN); // a file over the limit is an error code, not a signal
    limit(RLIMIT_CPU, cpu_seconds);
    ::mallopt(M_ARENA_MAX, kMaxArenas);
}

std::string run(const std::vector<std::string>& arguments, uint64_t memory)
{
    if (arguments[0] == "inspect") return geokit::inspect_vdb(arguments[3]);
    const std::vector<std::string> names(arguments.begin() + 5, arguments.end());
    return geokit::spool_vdb(arguments[3], names, arguments[4], memory);
}

// OpenVDB logs to stdout. From here on libraries have stderr in its place, and the answer a handle of its own.
std::FILE* take_stdout()
{
    std::FILE* answer = ::fdopen(::dup(STDOUT_FILENO), "w");
    if (answer == nullptr || ::dup2(STDERR_FILENO, STDOUT_FILENO) < 0) ::_exit(EXIT_FAILURE);
    return answer;
}

// Exits without destructors, because deleting the trees of a damaged file may crash.
[[noreturn]] void finish(std::FILE* answer, const std::string& json, int status)
{
    std::fputs(json.c_str(), answer);
    std::fputc('\n', answer);
    std::fflush(answer);
    ::_exit(status);
}

} // namespace

int main(int argc, char** argv)
{
    const std::vector<std::string> arguments(argv + 1, argv + argc);
    const bool is_inspect = arguments.size() == 4 && arguments[0] == "inspect";
    const bool is_read = arguments.size() >= 5 && arguments[0] == "read";
    if (!is_inspect && !is_read) {
        std::fputs("usage: geokit_vdb_worker inspect MEMORY CPU_SECONDS FILE\n"
                   "       geokit_vdb_worker read MEMORY CPU_SECONDS FILE SPOOL_FOLDER [GRID...]\n",
            stderr);
        return 2;
    }
    std::FILE* answer = take_stdout();
    const uint64_t memory = std::strtoull(arguments[1].c_str(), nullptr, 10);
    restrain(memory, std::strtoull(arguments[2].c_str(), nullptr, 10));
    tbb::global_control threads(tbb::global_control::max_allowed_parallelism,
        std::max(1u, std::min(kMaxThreads, std::thread::hardware_concurrency())));
    try {
        finish(answer, run(arguments, memory), 0);
    } catch (const geokit::BridgeError& error) {
        finish(answer, geokit::to_json(error), 1);
    } catch (const std::bad_alloc&) {
        finish(answer, geokit::to_json(geokit::BridgeError("memory", "it needs more memory than allowed")), 1);
    } catch (const std::exception& error) {
        finish(answer, geokit::to_json(geokit::BridgeError("damaged", error.what())), 1);
    }
}
