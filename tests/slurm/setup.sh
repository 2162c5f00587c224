#!/usr/bin/env bash
# A Slurm of one host with accounting, for `make slurm-check`. Debian or Ubuntu, root, a machine or container of
# one's own: it writes /etc/slurm and /etc/munge and starts daemons (stop them again with `setup.sh stop`).
set -euo pipefail

if [ "$(id -u)" != 0 ]; then
    echo "setup.sh: needs root, on a machine or container of your own" >&2
    exit 2
fi

host=$(hostname -s)
cores=$(nproc)
memory=$(($(awk '/MemTotal/ {print $2}' /proc/meminfo) / 1024 * 9 / 10))
logs=/var/log/slurm

# End the daemons that an earlier call has started, and wait until they are gone.
stop() {
    local file pid
    for file in /run/slurmctld.pid /run/slurmd.pid /run/slurmdbd.pid /run/mysqld/slurm-check.pid /run/munge/munged.pid; do
        [ -s "$file" ] || continue
        pid=$(cat "$file")
        kill "$pid" 2>/dev/null || true
        for _ in $(seq 100); do
            kill -0 "$pid" 2>/dev/null || break
            sleep 0.2
        done
        rm -f "$file"
    done
}

# Wait until a command succeeds, at most half a minute.
await() {
    for _ in $(seq 60); do
        if "$@" >/dev/null 2>&1; then return 0; fi
        sleep 0.5
    done
    echo "setup.sh: gave up waiting for: $*; logs are in $logs" >&2
    return 1
}

if [ "${1:-start}" = stop ]; then
    stop
    exit 0
fi

missing=()
for package in slurm-wlm slurmdbd mariadb-server munge; do
    dpkg -s "$package" >/dev/null 2>&1 || missing+=("$package")
done
if [ ${#missing[@]} -gt 0 ]; then
    apt-get update -qq
    DEBIAN_FRONTEND=noninteractive apt-get -o DPkg::Lock::Timeout=300 install -y -qq --no-install-recommends "${missing[@]}"
fi

stop
mkdir -p /etc/slurm "$logs" /var/spool/slurmctld /var/spool/slurmd /run/munge /run/mysqld /var/log/munge
chown munge:munge /run/munge /var/log/munge
chown mysql:mysql /run/mysqld
[ -s /etc/munge/munge.key ] || { mungekey --create && chown munge:munge /etc/munge/munge.key; }
runuser -u munge -- munged --force
await munge -n

# A database server of its own, on a socket only. Its sizes are what slurmdbd asks for.
data=/var/lib/slurm-check-db
if [ ! -d "$data/mysql" ]; then
    mkdir -p "$data"
    chown mysql:mysql "$data"
    mariadb-install-db --user=mysql --datadir="$data" --auth-root-authentication-method=socket >"$logs/install-db.log"
fi
socket=/run/mysqld/slurm-check.sock
setsid mariadbd --user=mysql --datadir="$data" --socket="$socket" --pid-file=/run/mysqld/slurm-check.pid \
    --skip-networking --innodb-buffer-pool-size=128M --innodb-lock-wait-timeout=900 \
    </dev/null >"$logs/mariadbd.log" 2>&1 &
await mariadb-admin --socket="$socket" ping
password=$(od -An -N16 -tx1 /dev/urandom | tr -d ' \n')
mariadb --socket="$socket" <<SQL
create database if not exists slurm_acct_db;
create or replace user 'slurm'@'localhost' identified by '$password';
grant all on slurm_acct_db.* to 'slurm'@'localhost';
SQL

cat >/etc/slurm/slurmdbd.conf <<CONF
AuthType=auth/munge
DbdHost=localhost
SlurmUser=root
StorageType=accounting_storage/mysql
StorageHost=localhost
StorageUser=slurm
StoragePass=$password
StorageLoc=slurm_acct_db
LogFile=$logs/slurmdbd.log
PidFile=/run/slurmdbd.pid
CONF
chmod 600 /etc/slurm/slurmdbd.conf

# Containers have neither cgroups to write to nor systemd: processes are followed by their parents.
cat >/etc/slurm/slurm.conf <<CONF
ClusterName=mvest
SlurmctldHost=$host
SlurmUser=root
AuthType=auth/munge
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SchedulerType=sched/backfill
SelectType=select/cons_tres
SelectTypeParameters=CR_Core_Memory
ReturnToService=2
JobAcctGatherType=jobacct_gather/linux
JobAcctGatherFrequency=2
# A job over its memory is killed, as by the kernel on a cluster with cgroups.
JobAcctGatherParams=OverMemoryKill
AccountingStorageType=accounting_storage/slurmdbd
AccountingStorageHost=localhost
# Tasks 0 to 3 only, so that a sweep of a few jobs needs several arrays.
MaxArraySize=4
MaxJobCount=30000
KillWait=5
StateSaveLocation=/var/spool/slurmctld
SlurmdSpoolDir=/var/spool/slurmd
SlurmctldPidFile=/run/slurmctld.pid
SlurmdPidFile=/run/slurmd.pid
SlurmctldLogFile=$logs/slurmctld.log
SlurmdLogFile=$logs/slurmd.log
NodeName=$host CPUs=$cores RealMemory=$memory State=UNKNOWN
PartitionName=check Nodes=$host Default=YES MaxTime=INFINITE State=UP
CONF

# slurmdbd reads the address of its database server from the client's settings.
MYSQL_UNIX_PORT="$socket" slurmdbd
await sacctmgr -n show cluster
sacctmgr -n show cluster mvest | grep -q mvest || sacctmgr -i add cluster mvest >/dev/null
rm -f /var/spool/slurmctld/clustername
slurmctld
slurmd
await sh -c "sinfo -h -o %T | grep -Eq 'idle|mixed|allocated'"
sinfo
